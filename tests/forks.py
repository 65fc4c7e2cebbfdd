"""Processes that start with everything imported, which takes most of the time of a short run."""

import multiprocessing
import os
import resource
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from bevcli.cli.main import app, program

FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(
    [
        "bevcli.cli.main",
        "bevcli.cli.run",
        "bevcli.inference.load",
        "bevcli.runs.run_into_folder",
        "numba.core.registry",
        "rerun.blueprint.api",
        "typer._adapters",
    ]
)


def run_in_fork(
    folder: Path,
    arguments: Sequence[str],
    texts: str,
    file_size: int | None = None,
    before: Callable[[], object] | None = None,
) -> None:
    """What a process of `FORKS` does: `bevcli` with these arguments in a folder, its output in the file `texts`."""
    os.chdir(folder)
    with open(texts, "w") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    sys.argv = ["bevcli", *arguments]
    torch.set_num_threads(1)  # the last bits of a result depend on the number of threads
    if file_size is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (file_size, file_size))
    if before:
        before()
    with program():
        app()
