"""The vehicle's motion, measured from the images and the calibration alone.

In the order of the work:
    measure              the entry point: reads a drive frame by frame; the measured motion, and the drive with it
    measured_steps       measured steps, and how far other steps are from them in standard deviations
    stated               stated poses at the times of frames, and common mistakes in them, undone one by one
    compare              stated poses against the measured motion: the mistake that explains their difference
"""

from bevcli.options import option, options


@options("Odometry")
class OdometryOptions:
    """The assumptions of `odometry`: standard deviations of what is stated."""

    height_m: float = option(
        default=0.003, help="How far off the stated height of the cameras over the road may be: standard deviation, "
        "metres.", minimum=0.0001, maximum=0.5,
    )  # fmt: skip
    baseline_deg: float = option(
        default=0.01, help="How far off the stated angle between two cameras that see the same may be: standard "
        "deviation, degrees.", minimum=0.0001, maximum=5,
    )  # fmt: skip
