"""CheckOptions: the options of `bevcli project-debug`."""

from __future__ import annotations

from pathlib import Path

from bevcli.inference.options import complete_model
from bevcli.options import option, options


@options()
class CheckOptions:
    """The sequence that belongs to a calibration, the model that its rig is compared with, and the output."""

    sequence: Path | None = option(
        reads="path", default=None, help="A sequence folder whose images and ego-motion belong to the calibration."
    )
    frame: int = option(default=0, help="Index of the frame whose images are drawn on.", minimum=0)
    out: Path | None = option(default=None, help="The output folder. Default: runs/NAME-project-debug.")
    model: str = option(
        reads="path or name",
        default="demo",
        help="Compare the rig with those that this model's weights were trained on: a model name or a FILE.toml.",
        metavar="NAME|FILE",
        complete=complete_model,
    )
