"""The package of docs/extend.md, installed and run."""

import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from functools import partial
from pathlib import Path
from textwrap import dedent

import pytest
from command_line import MINI_TOML
from forks import FORKS, run_in_fork

from bevcli.registry import entries, installed

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/extend.md").read_text()
NAMED_BLOCK = re.compile(r"^ *`([\w./]+)`:\n\n *```\w+\n(.*?)^ *```", flags=re.MULTILINE | re.DOTALL)
FILES = {name: dedent(text) for name, text in NAMED_BLOCK.findall(PAGE)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of the page with the metadata that pip writes, and a drive file."""
    folder = tmp_path_factory.mktemp("extension")
    for name, text in FILES.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    (folder / "bevcli_ground/__init__.py").touch()
    groups = tomllib.loads(FILES["pyproject.toml"])["project"]["entry-points"]
    metadata = folder / "bevcli_ground-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: bevcli-ground\nVersion: 1.0\n")
    texts = [f"[{group}]\n" + "".join(f"{n} = {v}\n" for n, v in found.items()) for group, found in groups.items()]
    (metadata / "entry_points.txt").write_text("\n".join(texts))
    (folder / "samples").symlink_to(ROOT / "samples")
    python(folder, "make_drive.py")
    return folder


def python(folder: Path, *arguments: str) -> str:
    """The output of Python with the package installed."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{shlex.join(command)}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def bevcli(folder: Path, *arguments: str) -> str:
    """The output of `bevcli` with the package installed."""
    texts = folder / "texts"
    before = partial(install, folder)
    process = FORKS.Process(target=run_in_fork, args=(folder, arguments, str(texts)), kwargs={"before": before})
    process.start()
    process.join(240)
    assert process.exitcode == 0, f"{shlex.join(arguments)}\n{texts.read_text()}"
    return texts.read_text()


def install(folder: Path) -> None:
    sys.path.insert(0, str(folder))
    installed.cache_clear()
    entries.cache_clear()


def test_the_pages_commands_run(folder):
    [block] = re.findall(r"^```sh\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)
    install, make_drive, *commands = block.splitlines()
    assert (install, make_drive) == ("pip install .", "python make_drive.py")  # the fixture does both
    for line in commands:
        program, *arguments = shlex.split(line)
        assert program == "bevcli"
        printed = bevcli(folder, *arguments)
    assert re.fullmatch(r"((car|pedestrian) \d+\n)+", printed)
    summary = json.loads((folder / "runs/ground/summary.json").read_text())
    assert summary["frames"] == 2  # of three, by --skip 1


def test_help_lists_the_command_of_the_page(folder):
    shown = bevcli(folder, "--help")
    assert (
        shown.index("Deploy") < shown.index("Other commands") < shown.index("Print the number of boxes of each class")
    )
    assert "--min-score" in bevcli(folder, "count", "--help")
    assert "--skip" in bevcli(folder, "run", "--help")


@pytest.mark.slow
def test_the_engine_of_the_page_runs_an_exported_file(folder):
    pytest.importorskip("onnxruntime")
    (folder / "mini.toml").write_text(MINI_TOML)
    bevcli(folder, "export-onnx", "--model", "mini.toml", "--untrained", "-o", "mini.onnx")
    code = (
        "import bevcli; drive = bevcli.open_sequence('samples/street', frames=slice(0, 1))\n"
        "for engine in ('unoptimised', 'onnxruntime'):\n"
        "    _, prediction = next(bevcli.run(bevcli.load_model('mini.onnx', engine=engine), drive))\n"
        "    print(prediction.boxes.centers.round(3).tolist())"
    )
    plain, optimised = python(folder, "-c", code).splitlines()
    assert plain == optimised
    options = ("--engine", "unoptimised", "--frames", "0:1", "--out", "runs/engine")
    bevcli(folder, "run", "samples/street", "--model", "mini.onnx", *options)
    assert json.loads((folder / "runs/engine/summary.json").read_text())["frames"] == 1
