"""Processes that start with everything imported, which takes most of the time of a short run."""

import multiprocessing

FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(
    [
        "bevcli.cli.main",
        "bevcli.cli.run",
        "bevcli.inference.load",
        "bevcli.runs.run_into_folder",
        "bevcli.training.trainer",
        "numba.core.registry",
        "rerun.blueprint.api",
        "torch._dynamo",  # optimizers import it
        "typer._adapters",
    ]
)
