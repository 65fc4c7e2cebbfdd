"""The same drives with corrupted images, calibration, times and ego-motion, scored one by one.

In the order of a test: `conditions` (all corruptions with their severities, and the sequences that apply them),
`stress` (the entry point, stress.json and the table).
"""

from pathlib import Path
from typing import Literal

from bevcli.options import option, options
from bevcli.workshop.scores import MAX_RANGE_HELP

LostImage = Literal["black", "missing"]
SeverityChoice = Literal["easy", "mid", "hard", "all"]


@options("Conditions")
class StressOptions:
    """The options of a stress test."""

    seed: int = option(default=0, help="Seed of all random numbers of the corruptions.", minimum=0)
    lost_images: LostImage = option(
        default="black", help="What the model gets for a lost image: a black image, as in RoboBEV, or none."
    )
    calibrate: bool = option(
        default=False,
        help="Measure the calibration of each drive first, as `bevcli calibrate` does, and use the corrected one.",
    )
    temporal: bool = option(
        default=True, help="Use the frames before (and after).", panel="Model", flag="--temporal/--no-temporal"
    )
    max_range_m: float | None = option(default=None, help=MAX_RANGE_HELP, flag="--max-range", metavar="METRES")
    against: Path | None = option(
        reads="path",
        default=None,
        help="The stress.json of another model on the same drives: adds corruption errors and mCE.",
        panel="Output",
        metavar="FILE",
    )


@options("Output")
class StressOutputOptions:
    """The conditions of `bevcli stress`, and its output folder."""

    severity: SeverityChoice = option(
        default="all",
        help="Only this severity. Of the levels of calibration noise, 1 is easy, 2 and 3 are mid, 4 is hard.",
        panel="Conditions",
    )
    only: tuple[str, ...] = option(
        default=(),
        help="Only this corruption: camera_crash, frame_lost, color_quantisation, motion_blur, brightness, low_light, "
        "fog, snow, calibration_noise, body_pitch, time_offset, ego_motion_lost or frame_rate. Repeatable. Clean "
        "drives are always scored.",
        panel="Conditions",
        metavar="NAME",
        repeatable=True,
    )
    out: Path | None = option(default=None, help="Folder for stress.json. Default: runs/stress-MODEL.", metavar="DIR")
    force: bool = option(default=False, help="Replace the files of an earlier test in the output folder.")
    resume: bool = option(
        default=False,
        help="Go on with a test in the output folder, after its last finished scene. The model, the options and the "
        "drives must be the same; conditions may be added.",
    )
