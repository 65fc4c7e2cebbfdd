"""The README's commands work as they stand: every `sh` block is run, every other mention is a known command."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from bevcli.cli.main import app

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)
RUN = [line for language, block in BLOCKS if language == "sh" for line in block.splitlines() if line]
SHOWN = [line for language, block in BLOCKS if language == "text" for line in block.splitlines()]
OPENS_A_VIEWER = re.compile(r"^bevcli viz \S+$")


def test_readme_commands_run(tmp_path):
    (tmp_path / "samples").symlink_to(ROOT / "samples")
    assert len(RUN) > 5
    for line in RUN:
        if OPENS_A_VIEWER.match(line):
            continue
        command, *arguments = shlex.split(line)
        assert command == "bevcli"
        done = subprocess.run(
            [sys.executable, "-m", "bevcli", *arguments], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"


@pytest.mark.parametrize("line", [line for line in SHOWN if line.startswith("bevcli ")])
def test_shown_commands_have_known_options(line):
    words = shlex.split(line, comments=True)[1:]
    command = typer.main.get_command(app)
    for word in words:
        if hasattr(command, "commands"):
            assert word in command.commands, word
            command = command.commands[word]
    known = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
    assert {word for word in words if word.startswith("--")} <= known


def test_linked_files_exist():
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (ROOT / target).exists(), target
