"""The README's examples run as they stand: the commands of its `sh` blocks, and its Python code."""

import contextlib
import re
import shlex
from pathlib import Path

import pytest
from command_line import command

from bevcli.published import read_sources

ROOT = Path(__file__).parents[1]
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", (ROOT / "README.md").read_text(), flags=re.MULTILINE | re.DOTALL)
OPENS_A_VIEWER = re.compile(r"^bevcli viz \S+$")


def blocks(language: str) -> list[str]:
    return [block for name, block in BLOCKS if name == language]


@pytest.mark.parametrize("first", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["first block", "all"])
def test_the_commands_run(clone: Path, first: bool) -> None:
    lines = [line for block in blocks("sh")[: 1 if first else None] for line in block.splitlines() if line]
    assert len(lines) > (2 if first else 5)
    for line in lines:
        program, *arguments = shlex.split(line)
        assert program == "bevcli"
        if not OPENS_A_VIEWER.match(line):
            done = command(clone, *arguments)
            assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"


@pytest.mark.slow
def test_the_python_example_writes_a_recording(clone: Path) -> None:
    [example] = blocks("python")
    with contextlib.chdir(clone):
        exec(example, {})
    assert (clone / "street.rrd").stat().st_size > 100_000


def test_readme_and_weights_page_name_what_weights_list_does(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))  # without names of the user
    listed = list(read_sources())
    [names] = re.findall(r"^The names are (.*?)\. ", (ROOT / "README.md").read_text(), flags=re.MULTILINE | re.DOTALL)
    assert re.findall(r"`(.+?)`", names) == listed
    rows = re.findall(r"^\| `(.+?)` \|", (ROOT / "docs/weights.md").read_text(), flags=re.MULTILINE)
    assert rows == listed
