"""Every command, option and path that a document names exists. `make docs` checks the links."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer

from bevcli.cli.main import app

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


def option_names(command: Any) -> set[str]:
    return HELP | {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}


def options_of_all_commands(command: Any) -> set[str]:
    names = command.list_commands(None) if hasattr(command, "commands") else ()
    parts = [command.get_command(None, name) for name in names]
    return option_names(command).union(*map(options_of_all_commands, parts))


# docs/extend.md adds a command of its own: tests/test_extend.py runs it.
@each([path for path in OF_TODAY if path.name != "extend.md"])
def test_shown_commands_and_options_are_known(document: Path) -> None:
    for line in shown_commands(document):
        words = shlex.split(line, comments=True)[1:]
        command = typer.main.get_command(app)
        while words and hasattr(command, "commands") and not words[0].startswith("-"):
            assert words[0] in command.list_commands(None), line
            command = command.get_command(None, words.pop(0))
        options = {word.partition("=")[0] for word in words if re.match(r"--?[a-z]", word)}
        assert options <= option_names(command), f"{line}: {options - option_names(command)}"


@each(OF_TODAY)
def test_options_in_the_prose_are_those_of_some_command(document: Path) -> None:
    mentioned = {name for span in code_spans(document) for name in re.findall(r"^--[\w-]+", span)}
    unknown = mentioned - options_of_all_commands(typer.main.get_command(app))
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
    assert all(
        (package / room).is_dir() or (package / room).with_suffix(".py").is_file() for room in rooms if "/" in room
    )


def make_targets() -> set[str]:
    return set(re.findall(r"^([a-z][\w-]*):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))


@each(OF_TODAY)
def test_make_targets_in_the_prose_exist(document: Path) -> None:
    mentioned = {span.split()[-1] for span in code_spans(document) if re.fullmatch(r"(\w+=\S+ )?make [\w-]+", span)}
    assert mentioned <= make_targets()
