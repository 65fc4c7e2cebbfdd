"""Commands for typer: `--help` in plain text, by panels, readable in a terminal of 80 columns; no empty paths."""

import inspect
import sys
from pathlib import Path
from typing import Any, get_args

import typer
from typer.core import TyperCommand


def printable(text: str) -> str:
    """The text in the characters that stdout knows, with escapes for others; typer would print UTF-8 regardless."""
    encoding = sys.stdout.encoding or "utf-8"
    return text.encode(encoding, "backslashreplace").decode(encoding)


class PlainCommand(TyperCommand):
    """A command whose `--help` lists its options by their panels."""

    def get_help(self, ctx: Any) -> str:
        return printable(super().get_help(ctx))

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse; an empty path, as of a variable that is not set, would be the current folder."""
        given, *_ = self.make_parser(ctx).parse_args(args=list(args))
        takes = inspect.signature(self.callback).parameters if self.callback else {}
        parameters: list[Any] = self.get_params(ctx)
        for each in parameters:
            value = given.get(each.name)
            empty = "" in (value if isinstance(value, list | tuple) else [value])
            if empty and each.name in takes and _takes_path(takes[each.name].annotation):
                raise typer.BadParameter("is empty (expected a path, . for this folder)", ctx=ctx, param=each)
        return super().parse_args(ctx, args)

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """The options and the arguments, without hidden ones."""
        shown = [each for each in self.get_params(ctx) if not getattr(each, "hidden", False)]
        return ["[OPTIONS]", *(piece.strip("{}") for each in shown for piece in each.get_usage_pieces(ctx))]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, then the options by panels, last those without one."""
        panels: dict[str, list[tuple[str, str]]] = {"Arguments": []}
        for each in self.get_params(ctx):
            is_argument = each.param_type_name == "argument"
            panel = "Arguments" if is_argument else getattr(each, "rich_help_panel", None)
            row = each.get_help_record(ctx)
            if row is not None:
                name = each.metavar if is_argument and each.metavar else row[0]
                panels.setdefault(panel or "Options", []).append((name, row[1]))
        panels["Options"] = panels.pop("Options", [])
        write_panels(panels, formatter)


def _takes_path(hint: Any) -> bool:
    return hint is Path or any(_takes_path(each) for each in get_args(hint))


def write_panels(panels: dict[str, list[tuple[str, str]]], formatter: Any) -> None:
    """Write the names and texts of each panel below its heading."""
    for panel, rows in panels.items():
        if rows:
            with formatter.section(panel):
                formatter.write_dl(rows)
