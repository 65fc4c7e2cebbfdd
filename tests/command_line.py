"""`bevcli` as its user types it, as a function call or a program; and a model file whose steps take milliseconds."""

import contextlib
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO
from unittest.mock import patch

from click.testing import Result
from typer.testing import CliRunner

from bevcli.cli import main

MINI_TOML = """
name = "mini"
classes = ["car", "truck", "construction_vehicle", "bus", "trailer",
  "barrier", "motorcycle", "bicycle", "pedestrian", "traffic_cone"]
cameras = ["CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT"]
channels = 16
[image]
size = [80, 45]
color_order = "rgb"
mean = [123.0, 116.0, 103.0]
std = [58.0, 57.0, 57.0]
[bev_grid]
rows = 8
columns = 8
[backbone]
blocks = [1, 1, 1, 1]
width = 4
[encoder]
layers = 1
attention_heads = 2
[decoder]
layers = 1
attention_heads = 2
queries = 20
max_boxes = 10
[tracking]
birth_score = 0.0
keep_score = 0.0
"""


def start(folder: Path, *arguments: str) -> subprocess.Popen:
    """`bevcli …` in a folder, with one thread per process."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "bevcli", *arguments]
    return subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )


def command(folder: Path, *arguments: str) -> subprocess.CompletedProcess:
    """`bevcli …` in a folder as a function call: the exit code and texts of the program without its start."""
    with contextlib.ExitStack() as stack:
        out, err = (stack.enter_context(tempfile.NamedTemporaryFile("w")) for _ in range(2))
        stack.enter_context(contextlib.redirect_stdout(out))
        stack.enter_context(contextlib.redirect_stderr(err))
        stack.enter_context(contextlib.chdir(folder))
        stack.enter_context(patch.dict(os.environ))
        stack.enter_context(patch.object(sys, "argv", ["bevcli", *map(str, arguments)]))
        code = 0
        try:
            with main.program():
                main.app()
        except SystemExit as end:
            code = end.code or 0
        texts = [flushed(file) for file in (out, err)]
    return subprocess.CompletedProcess(arguments, code, *texts)


def invoked(*arguments: object, code: int = 0) -> Result:
    """`bevcli …` as a function call that ends with an exit code; the errors that the program prints are raised."""
    result = CliRunner().invoke(main.app, [*map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == code, result.output
    return result


@contextlib.contextmanager
def full_disk(most: int) -> Iterator[None]:
    """A limit on the size of files in bytes, which to a program that writes is what a full disk is."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def flushed(file: IO[str]) -> str:
    file.flush()
    return Path(file.name).read_text()
