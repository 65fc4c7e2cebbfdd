"""Generate the page docs/commands.md: `python docs/site/commands_page.py > docs/commands.md`."""

from collections.abc import Iterator
from typing import Any, get_args

import typer

from bevcli.cli.main import app

HEAD = """# Commands

The options of every command by the panels of `--help`. A value in brackets is the default. This page is generated:
`python docs/site/commands_page.py > docs/commands.md`.
"""


def page() -> str:
    """The page as Markdown."""
    return "\n".join([HEAD, *_command("bevcli", typer.main.get_command(app))])


def _command(name: str, command: Any) -> Iterator[str]:
    """The lines of a command, or of those of a group."""
    if hasattr(command, "commands"):
        for each in command.list_commands(None):
            yield from _command(f"{name} {each}", command.get_command(None, each))
        return
    shown = [each for each in command.params if not each.hidden]
    arguments = [each for each in shown if each.param_type_name == "argument"]
    places = "".join(f" {_place(each)}" for each in arguments)
    yield from (f"## {name}\n", f"`{name}{places} [OPTIONS]`\n", _escaped(command.help) + "\n")
    yield from (f"- `{_place(each)}`: {_escaped(each.help or '')}" for each in arguments)
    panels: dict[str, list[Any]] = {}
    for each in shown:
        if each not in arguments and each.name != "help":
            panels.setdefault(each.rich_help_panel or "Options", []).append(each)
    for panel, options in panels.items():
        yield from (f"\n| {panel} | |", "|---|---|")
        yield from (f"| {_spelling(each)} | {_escaped(each.help or '')}{_default(each)} |" for each in options)
    yield ""


def _place(argument: Any) -> str:
    text = argument.metavar or argument.name.upper()
    return text if argument.required else f"[{text}]"


def _spelling(option: Any) -> str:
    """The flag with its value, such as "`--rate HZ|all`"."""
    choices = get_args(option.type_descriptor.annotation)
    value = "" if option.is_flag else f" {option.metavar or '|'.join(map(str, choices)) or 'VALUE'}"
    flags = [f"`{flag}{value}`" for flag in (*option.opts, *option.secondary_opts)]
    return ", ".join(flags).replace("|", "\\|")


def _default(option: Any) -> str:
    if option.required:
        return " (required)"
    is_plain = option.default in (None, False, "", ()) or (option.is_flag and not option.secondary_opts)
    return "" if is_plain else f" [{option.opts[0] if option.is_flag else option.default}]"


def _escaped(text: str) -> str:
    """A help text in Markdown, where bars in a table and angles need an escape."""
    paragraphs = (" ".join(each.split()) for each in text.split("\n\n"))
    return "\n\n".join(paragraphs).replace("|", "\\|").replace("<", "\\<")


if __name__ == "__main__":
    print(page(), end="")
