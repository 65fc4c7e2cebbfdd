"""The README's examples run as they stand: the commands of its `sh` blocks, and its Python code."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", (ROOT / "README.md").read_text(), flags=re.MULTILINE | re.DOTALL)
OPENS_A_VIEWER = re.compile(r"^bevcli viz \S+$")


def blocks(language: str) -> list[str]:
    return [block for name, block in BLOCKS if name == language]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the samples, as a clone has them."""
    (tmp_path / "samples").symlink_to(ROOT / "samples")
    return tmp_path


def run_python(arguments: list[str], folder: Path) -> None:
    done = subprocess.run([sys.executable, *arguments], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{shlex.join(arguments)}\n{done.stdout}\n{done.stderr}"


def test_the_commands_run(folder: Path) -> None:
    lines = [line for block in blocks("sh") for line in block.splitlines() if line]
    assert len(lines) > 5
    for line in lines:
        command, *arguments = shlex.split(line)
        assert command == "bevcli"
        if not OPENS_A_VIEWER.match(line):
            run_python(["-m", "bevcli", *arguments], folder)


def test_the_python_example_writes_a_recording(folder: Path) -> None:
    [example] = blocks("python")
    run_python(["-c", example], folder)
    assert (folder / "street.rrd").stat().st_size > 1_000_000
