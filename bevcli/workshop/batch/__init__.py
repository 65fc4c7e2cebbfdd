"""Thousands of drives: distributes drives to workers, each of which runs a drive as `bevcli run` does.

In the order of a batch: `storage`, `job` (the drives, what they are run with, and their records), `worker` (one drive,
here or on Ray), `report` (the tables and the page), `batch` (the loop).
"""

import importlib.util
from pathlib import Path

from bevcli.options import option, options


def ray_is_installed() -> bool:
    """Ray is installed."""
    return importlib.util.find_spec("ray") is not None


@options("Workers")
class Workers:
    """The number of workers on Ray, and the resources of each."""

    count: int | None = option(
        default=None,
        help="Number of workers. Default: one per GPU, else one per core. 1 without --ray needs no Ray.",
        flag="--workers",
        metavar="N",
        minimum=1,
    )
    address: str | None = option(
        default=None,
        help="Address of a running Ray cluster, such as auto or 10.0.0.1:6379. Default: Ray on this machine.",
        flag="--ray",
        metavar="ADDRESS",
    )
    gpus: float | None = option(
        default=None,
        help="Share of a GPU of each worker, such as 0.5. Default: 1 if there are GPUs.",
        flag="--gpus-per-worker",
        metavar="F",
        minimum=0,
    )
    threads: int | None = option(
        default=None,
        help="CPU threads of each worker. Default: cores / workers, 1 on a cluster; without Ray all cores.",
        metavar="N",
        minimum=1,
    )
    retries: int = option(default=2, help="Further attempts after a drive has failed.", metavar="N", minimum=0)

    @property
    def in_this_process(self) -> bool:
        """True for one worker, and without Ray: drives then run one after another in this process."""
        return self.address is None and (self.count == 1 or (self.count is None and not ray_is_installed()))


@options("Output")
class BatchOptions:
    """The output of a batch, and its drives from a file."""

    out: str = option(help="Folder or URL of the batch.")
    listed: Path | None = option(
        reads="path",
        default=None,
        help="A text file with one drive per line; # starts a comment.",
        flag="--list",
        metavar="FILE",
        panel="Options",
    )
    resume: bool = option(
        default=False,
        help="Go on with the batch in the output folder: skip drives that are done or have failed. Drives whose files, "
        "model, weights or options differ run again.",
    )
    retry_failed: bool = option(default=False, help="With --resume: run failed drives again.")
    evaluate: bool = option(
        default=False,
        help="Score drives that have ground truth, each and all together (metrics.json).",
        flag="--eval",
    )


@options("Input")
class ReproduceOptions:
    """The part of nuScenes on which a model is scored, and the folder of the batch."""

    data: Path = option(reads="path", help="The nuScenes root.", metavar="DIR")
    version: str | None = option(
        default=None, help="Dataset version, such as v1.0-trainval. Default: the only one present."
    )
    split: str = option(default="val", help="Split that is scored: val, or mini_val of v1.0-mini.")
    out: Path | None = option(
        default=None, help="Folder of the batch. Default: runs/reproduce-NAME-SPLIT.", panel="Output"
    )
    resume: bool = option(
        default=False, help="Go on in the output folder: scenes that are done are not run again.", panel="Output"
    )
