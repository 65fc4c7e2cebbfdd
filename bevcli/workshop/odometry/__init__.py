"""The vehicle's motion, measured from the images and the calibration alone.

In the order of the work:
    frames               what is kept of a frame: its images, their features, the road seen from above
    above                how far the vehicle drove between two views of the road from above; points, and their residuals
    point_votes          how far the vehicle drove, by matched points that lie on the road; whether it stands
    unknowns             what is estimated of a step
    steps                the motions that a step may have: those that fit matched points and points of the road
    chain                the choice among them by the steps before and after
    measure              the entry point: reads a drive frame by frame; the measured motion, and the drive with it
    report               the measured motion in words and files, and against stated poses
    seen_points          the points of a step that a recording shows
    picture, recording   the way on the road, and curves
    run_option           the option `odometry` of `open_sequence`
    measured_steps       measured steps, and how far other steps are from them in standard deviations
    stated               stated poses at the times of frames, and common mistakes in them, undone one by one
    compare              stated poses against the measured motion: the mistake that explains their difference
    check_motion         the check of `bevcli project-debug`: which steps are measured, and which findings are left out
    live                 the motion of a live rig without poses, for `bevcli.Session`
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
