"""Weights files: reading, checking, converting, and one-line errors for files that cannot be used."""

import datetime
import json
import math
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import safetensors.torch
import torch
from command_line import invoked
from memory_drive import make_rig
from small_model import small_model

from bevcli.checkpoints import (
    bundled_weights,
    compare,
    expected_state,
    from_official,
    load_weights,
    read_checkpoint,
    require_fit,
)
from bevcli.config import known_models, load_config
from bevcli.errors import OutputError, WeightsError
from bevcli.geometry.bev_grid import BevGrid
from bevcli.inference.load import load_model
from bevcli.model.temporal_model import build_model
from bevcli.workshop.training.warm_start import warm_start
from bevcli.workshop.weights import model_file as parts
from bevcli.workshop.weights.model_file import convert, model_file_for, model_parts

KEYS = json.loads((Path(__file__).parent / "data" / "golden_keys.json").read_text())


def official_state(model: str) -> dict[str, torch.Tensor]:
    """A state dict with the official keys and shapes that takes no memory: every tensor is one expanded number."""
    return {key: torch.zeros(()).expand(shape) for key, shape in KEYS[model].items()}


@pytest.fixture
def official_tiny(tmp_path: Path) -> Path:
    path = tmp_path / "tiny_epoch_24.pth"
    meta = {"epoch": 24, "CLASSES": ("car",)}
    torch.save({"state_dict": official_state("tiny"), "meta": meta, "optimizer": {}}, path)
    return path


@pytest.mark.parametrize("model", ["tiny", pytest.param("small", marks=pytest.mark.slow), "base"])
def test_official_keys_map_one_to_one_to_the_keys_of_our_model(model: str) -> None:
    state = {key: torch.empty(shape, device="meta") for key, shape in KEYS[model].items()}
    assert compare(from_official(state)[0], expected_state(load_config(model))) == {}


V2_MODELS = ("v2-t1-base", "v2-t1", "v2-t2", "v2-t8")


def v2_keys(model: str) -> dict[str, list[int]]:
    """Key -> shape of an official BEVFormerV2 file, the keys for training only included."""
    keys = json.loads((Path(__file__).parent / "data" / "golden_keys_v2.json").read_text())
    return {**keys["v2-t1-base"], **keys[model], **keys["training only"]}


def official_v2(model: str, tmp_path: Path, **changes: tuple[int, ...]) -> Path:
    """An official BEVFormerV2 file of zeros that takes no space. changes: other shapes, by the last part of the key."""
    path = tmp_path / f"{model}.pth"
    shapes = {key: changes.get(key.rpartition(".")[2], tuple(shape)) for key, shape in v2_keys(model).items()}
    torch.save({"state_dict": {key: torch.zeros(()).expand(shape) for key, shape in shapes.items()}}, path)
    return path


@pytest.mark.parametrize(
    "model", [pytest.param(name, marks=[pytest.mark.slow] * (name != "v2-t8")) for name in V2_MODELS]
)
def test_parts_of_v2_files_for_training_are_named_and_left_out(model: str, tmp_path: Path) -> None:
    summary = read_checkpoint(official_v2(model, tmp_path))
    assert model in summary.models
    assert set(summary.models) <= {model, "v2-t1-base", "v2-t1"}  # these two differ only in what is left out
    groups = "" if model == "v2-t1-base" else " and 10 of 11 groups of object queries"
    assert summary.left_out == f"363 keys fcos3d_bbox_head.*{groups}"


def official_uniad(tmp_path: Path, *, version_1_0: bool) -> Path:
    """An official file of UniAD's first stage of zeros that takes no space, with all keys of its training."""
    file = json.loads((Path(__file__).parent / "data" / "golden_keys_uniad.json").read_text())
    shapes = {**KEYS["base"], **file["keys"], **file["unused"]}
    old = ("pts_bbox_head.query_embedding.", "pts_bbox_head.transformer.reference_points.", "bbox_size_fc.")
    shapes = {key: shape for key, shape in shapes.items() if version_1_0 or not key.startswith(old)}
    path = tmp_path / "uniad_base_track_map.pth"
    torch.save({"state_dict": {key: torch.zeros(()).expand(shape) for key, shape in shapes.items()}}, path)
    return path


@pytest.mark.parametrize(("version_1_0", "left_out"), [(False, 132), pytest.param(True, 137, marks=pytest.mark.slow)])
def test_keys_of_uniad_files_without_effect_are_left_out(version_1_0: bool, left_out: int, tmp_path: Path) -> None:
    summary = read_checkpoint(official_uniad(tmp_path, version_1_0=version_1_0))
    assert summary.models == ("uniad-track-map",)
    assert summary.left_out.startswith(f"{left_out} keys, such as ")


def test_other_differences_of_v2_files_are_refused(tmp_path: Path) -> None:
    path = official_v2("v2-t2", tmp_path, level_embeds=(5, 256))
    with pytest.raises(WeightsError, match=r"does not fit model v2-t2: .*1 misshapen: image_tokens\.level_embedding"):
        require_fit(read_checkpoint(path), "v2-t2", expected_state(load_config("v2-t2")))


def test_weights_inspect_names_objects_that_were_not_read(tmp_path: Path) -> None:
    path = tmp_path / "small.pth"
    torch.save({"state_dict": small_model().state_dict(), "meta": {"date": datetime.datetime(2022, 8, 16)}}, path)
    shown = invoked("weights", "inspect", path).stdout
    assert "not read        datetime.datetime (objects that are no weights" in shown
    assert read_checkpoint(path).not_read == ("datetime.datetime",)


@pytest.mark.parametrize("suffix", [".safetensors", ".pth"])
def test_saved_weights_are_loaded_again(tmp_path: Path, suffix: str) -> None:
    path, state = tmp_path / f"weights{suffix}", small_model(seed=1).state_dict()
    if suffix == ".pth":
        torch.save(state, path)
    else:
        safetensors.torch.save_file(state, path)
    model = small_model(seed=2)
    load_weights(path, model)
    for key, tensor in model.state_dict().items():
        assert torch.equal(tensor, state[key]), key


@pytest.mark.parametrize(
    ("wrap", "said"),
    [
        (lambda state: {"state_dict": {f"module.{key}": value for key, value in state.items()}}, 'prefix "module."'),
        (lambda state: {"state_dict": {f"model.{key}": value for key, value in state.items()}}, 'prefix "model."'),
        (lambda state: {"model": state, "optimizer": {"lr": 1.0}}, 'everything but "model"'),
        (lambda state: {"model": {f"module.{key}": value for key, value in state.items()}}, 'prefix "module."'),
        (
            lambda state: state | {f"ema_{key.replace('.', '_')}": 2 * value for key, value in state.items()},
            "running averages (ema_*)",
        ),
        *(  # averages only
            (
                lambda state, prefix=prefix: {"model_state_dict": {prefix + key: x for key, x in state.items()}},
                f'everything but "model_state_dict" and the prefix "{prefix}" of all names',
            )
            for prefix in ("ema_", "ema_model.", "ema.")
        ),
    ],
)
def test_weights_of_other_programs_are_read_with_a_note(wrap: Callable, said: str, tmp_path: Path) -> None:
    state = small_model(seed=1).state_dict()
    torch.save(wrap(state), tmp_path / "w.pth")
    found = read_checkpoint(tmp_path / "w.pth")
    assert found.state.keys() == state.keys()
    assert all(torch.equal(found.state[key], value) for key, value in state.items())
    assert said in found.left_out


@pytest.fixture(scope="module")
def demo_state() -> dict[str, torch.Tensor]:
    return dict(read_checkpoint(Path(str(bundled_weights("demo")))).state)


def of_seven_classes(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The weights with the rows of the first seven classes."""
    rows = [f"detection_head.class_branches.{k}.6.{kind}" for k in range(3) for kind in ("weight", "bias")]
    return state | {key: state[key][:7].clone() for key in rows}


def test_the_nearest_model_and_the_difference_are_named(demo_state: dict, tmp_path: Path) -> None:
    gone = "neck.lateral.0.bias"
    less = {key: tensor for key, tensor in demo_state.items() if key != gone}
    more = {"my.loss": torch.zeros(2)}
    third = {key: tensor for place, (key, tensor) in enumerate(demo_state.items()) if place % 3 == 0}
    cases = {
        f"1 tensor missing: {gone}": less,
        "1 tensor too many: my.loss": demo_state | more,
        f"1 tensor missing: {gone}; 1 tensor too many: my.loss": less | more,
        "7 classes instead of 10": of_seven_classes(demo_state),
        "7 classes instead of 10; 1 tensor too many: my.loss": of_seven_classes(demo_state) | more,
        f"1 tensor of another shape: {gone}: expected (96,), found (5,)": demo_state | {gone: torch.zeros(5)},
        f"{len(third)} of its {len(demo_state)} tensors are in the file": third,
    }
    for text, state in cases.items():
        path = tmp_path / "w.safetensors"
        safetensors.torch.save_file(state, path)
        expected = re.escape(f"fits none of the known models; nearest is demo: {text}: ")
        with pytest.raises(WeightsError, match=expected):
            convert(path, tmp_path / "out.safetensors")
    assert not (tmp_path / "out.safetensors").exists()


def test_a_model_file_for_other_classes_takes_the_weights(demo_state: dict, tmp_path: Path) -> None:
    path, out = tmp_path / "seven.safetensors", tmp_path / "my.toml"
    safetensors.torch.save_file(of_seven_classes(demo_state), path)
    with pytest.raises(WeightsError, match="7 classes instead of 10: `bevcli weights model-file"):
        load_model(weights=path)
    with pytest.raises(WeightsError, match="does not fit model demo: 7 classes instead of 10; "):
        load_model("demo", weights=path)
    command = ["weights", "model-file", path, out]
    names = "car,truck,forklift,bus,trailer,barrier,motorcycle"
    with pytest.raises(
        WeightsError, match=r"has 7 classes: pass their names in the order of the training as `classes`"
    ):
        invoked(*command)
    shown = invoked(*command, "--classes", names).stdout
    assert f"{out}: demo with 7 classes: car, truck, forklift, " in shown
    model = load_model(out, weights=path)
    assert model.name == "my"
    assert ",".join(model.config.classes) == names
    assert model.config.backbone == load_config("demo").backbone
    with pytest.raises(OutputError, match="already exists"):
        invoked(*command, "--classes", names)
    safetensors.torch.save_file(of_seven_classes(demo_state) | {"my.loss": torch.zeros(2)}, path)
    with pytest.raises(WeightsError, match=r"differs from demo, .* in more than classes: .*too many: my\.loss"):
        model_file_for(path, tmp_path / "other.toml")
    with pytest.raises(OutputError, match=r"ends in \.toml"):
        model_file_for(path, tmp_path / "my.txt")


def test_weights_of_another_grid_are_resampled_on_request(tmp_path: Path) -> None:
    path, model = tmp_path / "coarse.safetensors", small_model(seed=1)
    rows, columns = 6, 8
    y, x = torch.meshgrid(torch.arange(rows) + 0.5, torch.arange(columns) + 0.5, indexing="ij")
    model.bev_queries.embedding.data[:, 0] = (y / rows).flatten()
    model.bev_queries.embedding.data[:, 1] = (x / columns).flatten()
    model.bev_queries.row_embedding.data[:, 0] = y[:, 0] / rows
    safetensors.torch.save_file(model.state_dict(), path)
    grid = BevGrid(12, 16, x_range_m=(-16, 16), y_range_m=(-12, 12), z_range_m=(-3, 2), pillar_points=2)
    finer = small_model(seed=2, bev_grid=grid)
    with pytest.raises(WeightsError, match="3 misshapen"):
        load_weights(path, finer)
    warm_start(path, finer, "finer.toml", make_rig)
    cells = finer.bev_queries.embedding.data.reshape(12, 16, -1)
    # A linear gradient over the grid stays linear, except in the outermost half cells.
    torch.testing.assert_close(cells[1:-1, 3, 0], ((torch.arange(12) + 0.5) / 12)[1:-1])
    torch.testing.assert_close(cells[5, 1:-1, 1], ((torch.arange(16) + 0.5) / 16)[1:-1])
    torch.testing.assert_close(finer.bev_queries.row_embedding.data[1:-1, 0], ((torch.arange(12) + 0.5) / 12)[1:-1])


@pytest.mark.slow
def test_a_converted_file_holds_the_same_numbers(official_tiny: Path, tmp_path: Path) -> None:
    out = tmp_path / "tiny.safetensors"
    summary = convert(official_tiny, out)
    assert (summary.models, summary.official, summary.facts) == (("tiny",), False, {"epoch": "24", "model": "tiny"})
    before, after = read_checkpoint(official_tiny).state, read_checkpoint(out).state
    assert before.keys() == after.keys()
    assert all(torch.equal(before[key], after[key]) for key in before)


def test_every_missing_unexpected_and_misshapen_key_is_listed(tmp_path: Path) -> None:
    state = small_model().state_dict()
    gone = ["neck.lateral.0.weight", "encoder.layers.1.norms.2.bias"]
    for key in gone:
        del state[key]
    state |= {"one.more": torch.zeros(1), "two.more": torch.zeros(1)}
    state["bev_queries.embedding"] = torch.zeros(5, 32)
    path = tmp_path / "edited.safetensors"
    safetensors.torch.save_file(state, path)
    with pytest.raises(WeightsError) as caught:
        load_weights(path, small_model())
    message = str(caught.value)
    assert "edited.safetensors: does not fit model small-for-tests" in message
    assert f"2 missing: {gone[0]}, {gone[1]}" in message
    assert "2 unexpected: one.more, two.more" in message
    assert "1 misshapen: bev_queries.embedding: expected (48, 32), found (5, 32)" in message


def test_weights_of_another_model_are_refused_and_named(official_tiny: Path) -> None:
    model, untouched = small_model(), small_model().state_dict()
    summary = read_checkpoint(official_tiny)
    assert (summary.models, summary.official, summary.facts) == (("tiny",), True, {"epoch": "24"})
    assert len(summary.state) == len(KEYS["tiny"]) - 1
    with pytest.raises(WeightsError, match=r"expected a file name that ends in \.safetensors"):
        convert(official_tiny, official_tiny.with_name("out.pth"))
    with pytest.raises(WeightsError, match=r"nothing\.pth: weights file not found"):
        read_checkpoint(Path("nothing.pth"))
    with pytest.raises(WeightsError, match="does not fit model small-for-tests: it holds weights of tiny; "):
        load_weights(official_tiny, model)
    assert all(torch.equal(tensor, untouched[key]) for key, tensor in model.state_dict().items())


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
@pytest.mark.parametrize("contents", [b"", b"hello, I am a text\n", b"\x00" * 100, b"PK\x03\x04broken", b"\x80\x02."])
def test_a_file_that_does_not_contain_weights_is_an_error(tmp_path: Path, suffix: str, contents: bytes) -> None:
    path = tmp_path / f"file{suffix}"
    path.write_bytes(contents)
    with pytest.raises(WeightsError, match=rf"file\{suffix}: "):
        read_checkpoint(path)


@pytest.mark.parametrize("contents", [3, [1, 2], {}, {"state_dict": {}}, {"state_dict": {"a": 1}}])
def test_a_file_without_a_state_dict_is_an_error(tmp_path: Path, contents: object) -> None:
    path = tmp_path / "other.pth"
    torch.save(contents, path)
    with pytest.raises(WeightsError, match="contains no state dict"):
        read_checkpoint(path)


PARTS_OF = ("photographs", "uniad-track-map", "v2-t1", "vad-tiny")  # one of each class


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in PARTS_OF)) for name in known_models()]
)
def test_every_parameter_of_a_model_belongs_to_one_part(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    config = load_config(name)
    with torch.device("meta"):
        model = build_model(config)
    monkeypatch.setattr(parts, "build_model", lambda config: model)
    expected = sum(parameter.numel() for parameter in model.parameters())
    assert sum(part.parameters for part in model_parts(config)) == expected


def test_the_parts_of_base_have_the_published_sizes() -> None:
    parts = {part.name: part for part in model_parts(load_config("base"))}
    assert parts["BEV queries"].shapes == ((200 * 200, 256),)
    assert parts["camera embeddings"].parameters == 6 * 256
    # 8 heads, 4 levels, 8 points: offsets (x, y) and weights; then value and output projection; all with biases.
    samples = 8 * 4 * 8
    expected = (2 * samples + samples) * (256 + 1) + 2 * 256 * (256 + 1)
    assert parts["encoder layer 5: spatial cross-attention"].parameters == expected
    not_learned = ("running_mean", "running_var", "num_batches_tracked", "code_weights")
    published = sum(math.prod(shape) for key, shape in KEYS["base"].items() if not key.endswith(not_learned))
    assert sum(part.parameters for part in parts.values()) == published


def test_weights_inspect_lists_the_parts_of_a_model() -> None:
    lines = invoked("weights", "inspect", "--model", "tiny").stdout.splitlines()
    assert any(line.startswith("BEV queries ") and "640,000  2500 × 256" in line for line in lines)
    end = lines[0].index("  shapes")  # of the column "parameters", which is aligned to the right
    total = sum(int(line[:end].split()[-1].replace(",", "")) for line in lines[1:-1])
    assert lines[-1].split() == ["total", f"{total:,}"]


def test_weights_inspect_gives_file_and_parts_as_json(official_tiny: Path) -> None:
    data = json.loads(invoked("weights", "inspect", official_tiny, "--model", "tiny", "--json").stdout)
    assert (data["models"], data["model"]) == (["tiny"], "tiny")
    assert data["file_bytes"] == official_tiny.stat().st_size
    assert data["model_parameters"] == sum(part["parameters"] for part in data["parts"]) < data["parameters"]
    queries = {"name": "BEV queries", "modules": ["bev_queries.embedding"]}
    assert {**queries, "parameters": 640_000, "shapes": [[2500, 256]]} in data["parts"]
    with pytest.raises(WeightsError, match="does not fit model base: it holds weights of tiny; "):
        invoked("weights", "inspect", official_tiny, "--model", "base")
    invoked("weights", "inspect", code=2)
