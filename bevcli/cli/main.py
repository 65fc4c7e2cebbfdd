"""`bevcli`: the commands and the exit codes.

Exit codes: 0 success, 1 a mistake in the input, 2 a mistake in usage (click's own), 130 stopped by Ctrl-C,
143 by SIGTERM; a command may have one of its own. No command module imports torch, OpenCV or rerun before it is called.
"""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer

from bevcli import __version__
from bevcli.cli.batch import batch
from bevcli.cli.bench import bench
from bevcli.cli.convert import convert
from bevcli.cli.demo import demo
from bevcli.cli.eval import evaluate
from bevcli.cli.explain import explain
from bevcli.cli.export import export
from bevcli.cli.export_onnx import export_onnx
from bevcli.cli.find_like import find_like
from bevcli.cli.project_debug import project_debug
from bevcli.cli.quantize import quantize
from bevcli.cli.render import render
from bevcli.cli.run import run
from bevcli.cli.samples import samples
from bevcli.cli.stress import stress
from bevcli.cli.train import train
from bevcli.cli.validate import validate
from bevcli.cli.viz import viz
from bevcli.cli.weights import weights_app
from bevcli.errors import BevcliError, WaitError
from bevcli.pipeline.cpu_memory import keep_freed_memory
from bevcli.pipeline.cpu_threads import THREAD_SETTINGS

app = typer.Typer(
    help="Run BEVFormer on sequences from any camera rig, and look at the results.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"bevcli {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Run BEVFormer on sequences from any camera rig, and look at the results."""


app.command()(batch)
app.command()(bench)
app.command()(convert)
app.command()(demo)
app.command("eval")(evaluate)
app.command()(explain)
app.command()(export)
app.command()(export_onnx)
app.command()(find_like)
app.command()(project_debug)
app.command()(quantize)
app.command()(render)
app.command()(run)
app.command()(samples)
app.command()(stress)
app.command()(train)
app.command()(validate)
app.command()(viz)
app.add_typer(weights_app, name="weights")


def run_app() -> None:
    """The console entry point: a user's mistake is one line on stderr and exit code 1, never a traceback."""
    for name, value in THREAD_SETTINGS.items():
        os.environ.setdefault(name, value)
    keep_freed_memory()
    try:
        try:
            app()
        finally:
            sys.stdout.flush()  # here, where an error can still be told
    except BevcliError as error:
        print(f"error: {error}", file=sys.stderr)
        if isinstance(error, WaitError):  # at its end, Python would wait for the thread that gets no answer
            sys.stderr.flush()
            os._exit(1)
        sys.exit(1)
    except BrokenPipeError:
        sys.stderr.close()  # the reader of the output is gone
        sys.exit(0)
    except OSError as error:  # the system refuses: no space, no permission, a name that is too long
        where = "" if error.filename is None else f"{error.filename}: "
        print(f"error: {where}{error.strerror or error}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes once more at its end
        sys.exit(1)
