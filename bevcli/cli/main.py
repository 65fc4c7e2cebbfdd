"""`bevcli`: the commands, their `--help` in plain text for a terminal of 80 columns, and the exit codes.

Exit codes: 0 success, 1 a mistake in the input, 2 a mistake in usage (click's own), 130 stopped by Ctrl-C,
143 by SIGTERM; a command may have one of its own. No command module imports torch, OpenCV or rerun before it is called.
"""

import errno
import inspect
import os
import re
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from bevcli._version import __version__
from bevcli.cli.bridge import command
from bevcli.errors import BevcliError, WaitError
from bevcli.inference.machine import THREAD_SETTINGS, keep_freed_memory
from bevcli.printing import one_line, prepare_output, reason_of, say
from bevcli.registry import entries, load

# The order of the commands' panels. A file of commands states theirs as `PANEL`, a text or a dict by the name of the
# command; those without one come last.
PANELS = ("Start", "Run", "Look", "Score", "Train", "Deploy", "Other commands")
GROUP = "bevcli.commands"
# Each library words it otherwise.
NO_MEMORY = re.compile(
    "map segment|out of memory|insufficient memory|bad_alloc|bad allocation|(?:cannot|can't|unable to) allocate"
    "|start new thread",
    re.I,
)
OURS = str(Path(__file__).parents[1])


def printable(text: str) -> str:
    """The text in the characters that stdout knows, with escapes for others; typer would print UTF-8 regardless."""
    encoding = sys.stdout.encoding or "utf-8"
    return text.encode(encoding, "backslashreplace").decode(encoding)


class PlainCommand(TyperCommand):
    """A command whose `--help` lists the options by their panels."""

    def get_help(self, ctx: Any) -> str:
        return printable(super().get_help(ctx))

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """The options and the arguments, without hidden ones."""
        shown = [param for param in self.get_params(ctx) if not getattr(param, "hidden", False)]
        return [
            "[OPTIONS]",
            *(re.sub(r"^\{(.*)\}", r"\1", piece) for param in shown for piece in param.get_usage_pieces(ctx)),
        ]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, then the options by panels, last those without one."""
        panels: dict[str, list[tuple[str, str]]] = {"Arguments": []}
        for param in self.get_params(ctx):
            is_argument = param.param_type_name == "argument"
            panel = "Arguments" if is_argument else getattr(param, "rich_help_panel", None)
            row = param.get_help_record(ctx)
            if row is not None:
                name = param.metavar if is_argument and param.metavar else row[0]
                panels.setdefault(panel or "Options", []).append((name, row[1]))
        panels["Options"] = panels.pop("Options", [])
        write_panels(panels, formatter)


def write_panels(panels: dict[str, list[tuple[str, str]]], formatter: Any) -> None:
    """Write the names and texts of each panel below its heading."""
    for panel, rows in panels.items():
        if rows:
            with formatter.section(panel):
                formatter.write_dl(rows)


class _Group(TyperGroup):
    """The registered commands, each built when it is asked for, and further ones. `--help` builds none."""

    commands: dict[str, Any]

    def list_commands(self, ctx: Any) -> list[str]:
        """The names of all commands; imports none of them."""
        self.commands = {**dict.fromkeys(entries(GROUP)), **self.commands}
        return list(self.commands)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of this name, None for an unknown one."""
        if self.commands.get(cmd_name) is None and cmd_name in entries(GROUP):
            app = load(GROUP, cmd_name)  # a function, or a Typer with several
            if not isinstance(app, typer.Typer):
                app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
                app.command(cmd_name, cls=PlainCommand)(command(load(GROUP, cmd_name)))
            self.commands[cmd_name] = typer.main.get_command(app)
            self.commands[cmd_name].name = cmd_name
        return self.commands.get(cmd_name)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except EOFError as error:  # typer would print "Aborted!" and nothing else
            advice = "if it is none of the input, delete the folders __pycache__ of the installation"
            raise BevcliError(f"a file that is read ends too early ({reason_of(error)}): {advice}") from error

    def get_help(self, ctx: Any) -> str:
        return printable(super().get_help(ctx))

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands by panels, with the summaries of their docstrings."""
        panels: dict[str, list[tuple[str, str]]] = {panel: [] for panel in PANELS}
        for name, entry in entries(GROUP).items():
            try:
                command = load(GROUP, name)
            except BevcliError as error:  # of another package
                say(f"warning: {error}", err=True)
                continue
            text = command.info.help if isinstance(command, typer.Typer) else command.__doc__
            summary = " ".join(inspect.cleandoc(text or "").partition("\n\n")[0].split())
            panel = getattr(sys.modules[entry.module], "PANEL", PANELS[-1])
            panel = panel if isinstance(panel, str) else panel[name]
            panels.setdefault(panel, []).append((name, summary))
        write_panels(panels, formatter)


app = typer.Typer(
    cls=_Group,
    rich_markup_mode=None,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(is_requested: bool) -> None:
    if is_requested:
        say(f"bevcli {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Run BEVFormer on sequences from any camera rig, and look at the results."""


@contextmanager
def program() -> Iterator[None]:
    """Settings and exit codes of a process that runs commands in the block.

    A user's mistake is one line on stderr and exit code 1, never a traceback.
    """
    for name, value in THREAD_SETTINGS.items():
        os.environ.setdefault(name, value)
    prepare_output()
    keep_freed_memory()
    try:
        try:
            yield
        finally:
            sys.stdout.flush()  # here, where an error can still be told
    except BevcliError as error:
        say(f"error: {error!s}", err=True)
        if isinstance(error, WaitError):  # at its end, Python would wait for the thread that gets no answer
            os._exit(1)
        sys.exit(1)
    except OSError as error:  # the system refuses: no space, no permission, a name that is too long
        prefix = "" if error.filename is None else f"{error.filename}: "
        message = None if error.strerror else system_error(error)
        full = prefix == "" and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        advice = " (of an output, or of the folder for temporary files, which TMPDIR names)" if full else ""
        say(f"error: {message or one_line(prefix + str(error.strerror or error) + advice)}", err=True)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes once more at its end
        sys.exit(1)
    except Exception as error:
        message = system_error(error)
        if message is None:
            raise
        say(f"error: {message}", err=True)
        os._exit(1)  # what Python does at its end needs memory too


def system_error(error: Exception) -> str | None:
    """The message for a lack of memory, or for a package that cannot be imported; None for any other error."""
    reason = one_line(reason_of(error), 300)
    if isinstance(error, UnicodeEncodeError) and "surrogates" in error.reason:
        return f"{one_line(error.object)}: is not a name in UTF-8: rename it"
    if _lacks_memory(error):
        return f"the system gives no more memory or threads: {reason}"
    package = _failed_import(error)
    if package:
        return f"the package {package} cannot be imported: {reason}; check its installation and environment variables"
    return None


def _lacks_memory(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, MemoryError) or NO_MEMORY.search(str(error)):
            return True
        error = error.__cause__ or error.__context__
    return False


def _failed_import(error: Exception) -> str:
    """The package of somebody else whose import has raised an error; "" for an error of anything else."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.startswith(OURS)]
    words = (frames[-1].line or "").split() if frames else []
    package = words[1].partition(".")[0] if words[:1] in (["import"], ["from"]) else ""
    return "" if package == "bevcli" else package
