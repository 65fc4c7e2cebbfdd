"""The vehicle's motion, measured from the images and the calibration alone.

In the order of the work:
    measure              the entry point: reads a drive frame by frame; the measured motion, and the drive with it
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
