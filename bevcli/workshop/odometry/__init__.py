"""The vehicle's motion, measured from the images and the calibration alone.

In the order of the work:
    step_views    what is kept of a frame, points matched in two of them and of the road, what is estimated
    steps         votes how far the vehicle drove, and the motions that fit matched points and points of the road
    measure       the entry point: the measured motion, chosen frame by frame, of a drive or of a live rig;
                  measured steps, and how far stated ones are from them
    report        the measured motion in words and files, and the option `odometry` of `open_sequence`
    picture       odometry.png and odometry.rrd: the way on the road, and curves
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
