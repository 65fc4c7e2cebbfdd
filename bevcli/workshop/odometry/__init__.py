"""The vehicle's motion, measured from the images and the calibration alone.

In the order of the work:
    views         what is kept of a frame: its images, their features, the road seen from above
    votes         how far the vehicle drove: the votes of tiles of the road, and of matched points
    flow          points of the road in two views from above
    step_views    two frames: the points matched in both, and what is estimated of the step between them
    steps         the motions that a step may have: those that fit matched points and points of the road
    measure       the entry point: the measured motion, chosen frame by frame, of a drive or of a live rig
    report        the measured motion in words and files, and against stated poses
    picture       odometry.png: the way on the road, and curves
    recording     odometry.rrd
    drives        the option `odometry` of `open_sequence`: drives with their measured motion
    stated        stated poses at the times of frames, and common mistakes in them, undone one by one
    compare       stated poses against the measured motion, and the check of `bevcli project-debug`
"""

from pathlib import Path

from bevcli.options import option, options


@options("Odometry")
class OdometryOptions:
    """The assumptions of `odometry`: standard deviations of what is stated."""

    height_m: float = option(
        default=0.003, help="How far off the stated height of the cameras over the road may be: standard deviation, "
        "metres.", minimum=0.0001, maximum=0.5,
    )  # fmt: skip


@options("Output")
class OdometryOutputOptions:
    """The output folder of `bevcli odometry`."""

    out: Path | None = option(default=None, help="Output folder. Default: runs/SEQUENCE-odometry.", metavar="DIR")
