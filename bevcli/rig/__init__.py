"""Diagnosis of a calibration: what is wrong with a camera rig, and drawings that show it. `CheckOptions`.

check_calibration    reads a calibration or a sequence, runs all checks, also of times; the result as text and files
coverage             the BEV cells that cameras see, and the rig next to nuScenes'
sequence_checks      all checks of a sequence: the rig in their order, and ego-motion; those before a run;
                     units, inverted transforms, quaternion order, axes: explanations of implausible poses
rig_checks           mounting, names and lenses of cameras; the bev frame
drawings             cameras.png, coverage.png and recording.rrd
"""

from pathlib import Path

from bevcli.inference import complete_model
from bevcli.options import option, options


@options()
class CheckOptions:
    """The sequence that belongs to a calibration, what it is compared with, and the output."""

    sequence: Path | None = option(
        reads="path", default=None, help="A sequence folder whose images and ego-motion belong to the calibration."
    )
    frame: int = option(default=0, help="Index of the frame whose images are drawn on.", minimum=0)
    out: Path | None = option(default=None, help="The output folder. Default: runs/NAME-project-debug.")
    model: str | None = option(
        reads="path or name",
        default=None,
        help="Compare the rig with those that this model's weights were trained on: a model name or a FILE.toml. "
        "Default: that of `bevcli run`.",
        metavar="NAME|FILE",
        complete=complete_model,
    )
    motion: bool = option(
        default=True,
        help="With a sequence, also measure its motion and its calibration from its images, and compare.",
        flag="--motion/--no-motion",
    )
