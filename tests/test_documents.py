"""Every command, option, key and path that a document names exists; docs/bevformer.md agrees with the models.

The examples run and are typed. `make docs` checks the links.
"""

import contextlib
import dataclasses
import os
import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Iterator
from fractions import Fraction
from functools import cache
from pathlib import Path
from runpy import run_path
from textwrap import dedent
from typing import Any

import pytest
import torch
import typer

import bevcli
from bevcli.cli.main import app
from bevcli.config import load_config
from bevcli.model.bevformer import BEVFormer
from bevcli.workshop.training.job import TrainingConfig

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
# The changelog describes earlier versions, whose commands and files may be gone.
OF_TODAY = [path for path in DOCUMENTS if path.name != "CHANGELOG.md"]

FENCED = re.compile(r"^ *```.*?^ *```", flags=re.MULTILINE | re.DOTALL)
CODE_SPAN = re.compile(r"(`+)(.+?)\1", flags=re.DOTALL)
HELP = {"--help", "-h"}


def each(documents: list[Path]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("document", documents, ids=lambda path: path.name)


def prose(document: Path) -> str:
    """The text without its fenced blocks."""
    return FENCED.sub("", document.read_text())


def code_spans(document: Path) -> list[str]:
    return [" ".join(text.split()) for _, text in CODE_SPAN.findall(prose(document))]


def shown_commands(document: Path) -> list[str]:
    """`bevcli …` in code spans and in the lines of fenced blocks, also as a module that Python runs."""
    blocks = "\n".join(FENCED.findall(document.read_text())).replace("\\\n", " ")
    lines = re.findall(r"^ *(?:\$ )?(?:[\w.]+ .*-m )?(bevcli(?: .*)?)$", blocks, flags=re.MULTILINE)
    return lines + [span for span in code_spans(document) if span == "bevcli" or span.startswith("bevcli ")]


@cache
def commands() -> Any:
    return typer.main.get_command(app)


def option_names(command: Any) -> set[str]:
    return HELP | {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}


@cache
def options_of_all_commands(command: Any) -> set[str]:
    names = command.list_commands(None) if hasattr(command, "commands") else ()
    parts = [command.get_command(None, name) for name in names]
    return option_names(command).union(*map(options_of_all_commands, parts))


# docs/extend.md adds a command of its own: tests/test_extend.py runs it.
@each([path for path in OF_TODAY if path.name != "extend.md"])
def test_shown_commands_and_options_are_known(document: Path) -> None:
    for line in shown_commands(document):
        words = shlex.split(line, comments=True)[1:]
        command = commands()
        while words and hasattr(command, "commands") and not words[0].startswith("-"):
            assert words[0] in command.list_commands(None), line
            command = command.get_command(None, words.pop(0))
        options = {word.partition("=")[0] for word in words if re.match(r"--?[a-z]", word)}
        assert options <= option_names(command), f"{line}: {options - option_names(command)}"


@each(OF_TODAY)
def test_options_in_the_prose_are_those_of_some_command(document: Path) -> None:
    mentioned = {name for span in code_spans(document) for name in re.findall(r"^--[\w-]+", span)}
    unknown = mentioned - options_of_all_commands(commands())
    assert not unknown


@each(OF_TODAY)
def test_files_of_the_repository_in_the_prose_exist(document: Path) -> None:
    for span in code_spans(document):
        if re.fullmatch(r"(bevcli|tests|docs|samples|configs|\.github)/[\w./-]+", span):
            assert (ROOT / span).exists(), span


def rooms_of_the_readme() -> list[str]:
    """The folders and modules of bevcli/ in the README's list, in its order; subfolders as "model/kernels"."""
    [block] = re.findall(r"^bevcli/\n(.*?)^```", (ROOT / "README.md").read_text(), flags=re.MULTILINE | re.DOTALL)
    rooms: list[str] = []
    for line in block.splitlines():
        indent, names = re.match(r"( +)(\S+(?: \S+)*)", line).groups()  # type: ignore[union-attr]
        inside = "" if indent == "  " else next(f"{room}/" for room in reversed(rooms) if "/" not in room)
        rooms += [f"{inside}{name.rstrip('/')}" for name in names.split()]
    return rooms


def test_readme_lists_every_folder_and_module_once() -> None:
    package = ROOT / "bevcli"
    found = [path.name for path in package.iterdir() if path.is_dir() and path.name not in ("__pycache__", "samples")]
    found += [path.stem for path in package.glob("*.py")]
    rooms = rooms_of_the_readme()
    assert sorted(room for room in rooms if "/" not in room) == sorted(found)
    paths = [package / room for room in rooms if "/" in room]
    assert all(path.is_dir() or path.with_suffix(".py").is_file() for path in paths)


def make_targets() -> set[str]:
    return set(re.findall(r"^([a-z][\w-]*):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))


@each(OF_TODAY)
def test_make_targets_in_the_prose_exist(document: Path) -> None:
    mentioned = {span.split()[-1] for span in code_spans(document) if re.fullmatch(r"(\w+=\S+ )?make [\w-]+", span)}
    assert mentioned <= make_targets()


DOCS = Path(__file__).parents[1] / "docs"
page = runpy.run_path(str(DOCS / "site/commands_page.py"))["page"]


def test_the_page_of_the_commands_is_current():
    text = page()
    assert (DOCS / "commands.md").read_text() == text, "run `python docs/site/commands_page.py > docs/commands.md`"
    assert "\n## bevcli weights convert\n" in text
    assert "| `--rate HZ\\|all` | Thin to this many frames per second. " in text
    assert "| `--temporal`, `--no-temporal` | Use the frames before (and after). [--temporal] |" in text


write_pages = run_path(str(ROOT / "docs/site/versions.py"))["write_pages"]


def test_the_first_page_leads_to_the_newest_version(tmp_path):
    for name in ("0.9.1", "0.10.0", "0.2.0", "doctrees"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "README.html").touch()
    write_pages(tmp_path)
    links = [re.findall(r'href="(.*?)"', (tmp_path / f"{page}.html").read_text()) for page in ("index", "versions")]
    assert links == [["0.10.0/README.html"], [f"{name}/README.html" for name in ("0.10.0", "0.9.1", "0.2.0")]]


def test_reference_names_every_public_name():
    named = re.findall(r"^- `bevcli\.(\w+)`: \S", (ROOT / "docs/reference.md").read_text(), flags=re.MULTILINE)
    assert sorted(named) == sorted(set(named))
    assert set(named) == set(bevcli.__all__) <= set(dir(bevcli))
    for name in bevcli.__all__:
        assert getattr(bevcli, name) is not None
    with pytest.raises(AttributeError, match="no_such_name"):
        bevcli.no_such_name  # noqa: B018


PYTHON_PAGE = (ROOT / "docs" / "python.md").read_text()
EXAMPLES = re.findall(r"^```python\n(.*?)^```", PYTHON_PAGE, flags=re.MULTILINE | re.DOTALL)


@pytest.mark.slow  # test_pages.py and the tests of each function run its calls
def test_the_examples_run(clone: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert len(EXAMPLES) > 8
    with contextlib.chdir(clone):
        exec("\n".join(EXAMPLES), {})
    assert "is missing (expected" in capsys.readouterr().out


PYTHON_BLOCKS = re.compile(r"^```python\n(.*?)^```", flags=re.MULTILINE | re.DOTALL)
NAMED = re.compile(r"^ *`([\w./]+\.py)`:\n\n *```python\n(.*?)^ *```", flags=re.MULTILINE | re.DOTALL)
# ROS 2, CARLA and ONNX Runtime have no types.
SETTINGS = """[mypy]
strict = true
follow_imports = silent
[mypy-rclpy.*,nav_msgs.*,sensor_msgs.*,vision_msgs.*,carla,onnxruntime]
ignore_missing_imports = true
[mypy-bevcli_node]
disallow_subclassing_any = false
"""


def page_of(name: str) -> str:
    return (ROOT / "docs" / name).read_text()


@pytest.mark.slow
def test_the_examples_pass_mypy_strict(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    files = {"python_page.py": "\n".join(PYTHON_BLOCKS.findall(page_of("python.md")))}
    for document in ("live.md", "extend.md", "service.md"):
        files |= {name: dedent(text) for name, text in NAMED.findall(page_of(document))}
    assert {"cameras.py", "bevcli_node.py", "carla_client.py", "bevcli_ground/ground.py", "drawing.py"} < files.keys()
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "bevcli_ground/__init__.py").touch()
    (tmp_path / "mypy.ini").write_text(SETTINGS)
    checked = [name for name in files if "/" not in name] + ["bevcli_ground"]
    command = [sys.executable, "-m", "mypy", "--config-file", "mypy.ini", *checked]
    environment = os.environ | {"MYPYPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def defaults(config: object, table: str = "") -> Iterator[tuple[str, object]]:
    """Key, with the names of its tables, and default value."""
    for field in dataclasses.fields(config):  # type: ignore[arg-type]
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from defaults(value, f"{table}{field.name}.")
        else:
            yield f"{table}{field.name}", value


def documented() -> Iterator[tuple[str, object]]:
    """Key and default value of each entry of the document's table. A key ".name" is in the table of the key before."""
    section = (DOCS / "training.md").read_text().partition("## The `[training]` table")[2].partition("\n## ")[0]
    for row in re.findall(r"^\| (`.*?) \| (.*?) \|", section, flags=re.MULTILINE):
        table = ""
        for key, value in zip(row[0].split(", "), row[1].split(", "), strict=True):
            name = key.strip("`")
            name = table + name if name.startswith(".") else name
            table = name.rpartition(".")[0]
            yield name, parsed(value)


def parsed(value: str) -> object:
    if value.startswith('"'):
        return value.strip('"')
    if value in ("true", "false"):
        return value == "true"
    if " to " in value or "; " in value:  # a range, or a list
        return tuple(float(number) for number in re.split(" to |; ", value))
    return float(Fraction(value))


def test_the_table_lists_every_key_with_its_default() -> None:
    expected = {key: with_floats(value) for key, value in defaults(TrainingConfig())}
    assert dict(documented()) == expected


def with_floats(value: object) -> object:
    if isinstance(value, tuple):
        return tuple(float(number) for number in value)
    return float(value) if type(value) in (int, float) else value


PAGE = ROOT / "docs/bevformer.md"
TEXT = PAGE.read_text(encoding="utf-8")
CAMERAS = 6
MODELS = ("tiny", "base")


def table_rows() -> dict[str, dict[str, str]]:
    """Name of a tensor or part -> model -> what the page states, in the tables of MODELS."""
    rows = {}
    for line in TEXT.splitlines():
        cells = [cell.strip().strip("`") for cell in line.strip("|").split("|")]
        if line.startswith("|") and len(cells) == 1 + len(MODELS) and cells[0] not in ("tensor", "part", "---"):
            assert cells[0] not in rows, f"{cells[0]} stands in two tables"
            rows[cells[0]] = dict(zip(MODELS, cells[1:], strict=True))
    return rows


def facts_of(name: str) -> dict[str, str]:
    """What the page should state of a model, from its modules on the meta device and from its configuration."""
    config = load_config(name)
    grid, channels = config.bev_grid, config.channels
    width, height = config.image.padded_size
    with torch.device("meta"), torch.inference_mode():
        model = BEVFormer(config).eval()
        images = torch.zeros(CAMERAS, 3, height, width)
        stages = model.backbone(images)
        levels = model.neck(stages)
        tokens = model.image_tokens(levels, torch.arange(CAMERAS)).tokens
        queries = model.bev_queries(torch.zeros(1, 18))[0]
        position = model.bev_queries.position()
        can_bus = model.bev_queries.can_bus_embedding(torch.zeros(1, 18))[0]
        class_logits, box_codes, _ = model.decoder(queries[None], model.detection_head)
        object_position = model.decoder.query_embedding[:, :channels]
        references = model.decoder.reference_points(object_position)
    pillars = grid.pillars().reshape(-1, grid.pillar_points, 3)
    encoder, decoder = config.encoder, config.decoder
    spatial = (encoder.attention_heads, config.neck.levels, encoder.spatial_points)
    temporal = (encoder.attention_heads, 2, 1, encoder.temporal_points, 2)
    layer = model.encoder.layers[0]
    assert torch.Size((*spatial, 2)).numel() == layer.spatial_cross_attention.attention.sampling_offsets.out_features
    assert torch.Size(temporal).numel() == layer.temporal_self_attention.attention.sampling_offsets.out_features
    stage_of = dict(zip(config.backbone.output_stages, stages, strict=True))
    shapes = {
        "images": images.shape,
        **{f"backbone, stage {stage}": stage_of[stage].shape if stage in stage_of else None for stage in (2, 3, 4)},
        **{f"neck, level {i + 1}": levels[i].shape if i < len(levels) else None for i in range(4)},
        "image tokens": tokens.shape,
        "BEV queries": queries.shape,
        "column embedding": model.bev_queries.column_embedding.shape,
        "row embedding": model.bev_queries.row_embedding.shape,
        "position embedding": position.shape,
        "can-bus numbers": (18,),
        "can-bus embedding": can_bus.shape,
        "shift": (2,),
        "pillar points": pillars.shape,
        "projection matrices": (CAMERAS, 4, 4),
        "reference points in the images": (CAMERAS, len(pillars), grid.pillar_points, 2),
        "spatial sampling points of a cell in a camera": (*spatial, 2),
        "spatial attention weights of a cell in a camera": spatial,
        "history BEV map": queries.shape,
        "temporal value maps": (2, *queries.shape),
        "temporal sampling points of a cell": temporal,
        "BEV map": queries.shape,
        "object queries": model.decoder.query_embedding.shape,
        "object reference points": references.shape,
        "class logits": class_logits[:, 0].shape,
        "box codes": box_codes[:, 0].shape,
    }
    facts = {label: "–" if shape is None else str(tuple(shape)) for label, shape in shapes.items()}
    facts["encoder layers"] = str(len(model.encoder.layers))
    facts["feed-forward width"] = str(layer.feed_forward.expand.out_features)
    facts["decoder layers"] = str(len(model.decoder.layers))
    facts["boxes kept"] = str(decoder.max_boxes)
    for part, module in model.named_children():
        if parameters := sum(parameter.numel() for parameter in module.parameters()):
            facts[part] = f"{parameters:,}"
    facts["all"] = f"{sum(parameter.numel() for parameter in model.parameters()):,}"
    return facts


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
def test_the_tables_state_the_shapes_and_sizes_of_the_models(model):
    assert {label: stated[model] for label, stated in table_rows().items()} == facts_of(model)


def test_named_classes_and_functions_are_in_the_linked_files():
    named = re.findall(r"`(\w+)` in\s+\[[^\]]+\]\(\.\./([^)]+\.py)\)", TEXT)
    assert len(named) > 20
    for name, file in named:
        assert re.search(rf"^(class|def) {name}\b", (ROOT / file).read_text(), re.MULTILINE), f"{name} in {file}"
