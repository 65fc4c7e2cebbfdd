"""A calibration that is measured from the drive itself.

In the order of the work, on top of the wing `correspondence`, which finds what two images share:
    estimates            what is estimated, the geometry that follows, what is said of each camera and of the whole rig
    views                the frame pairs that are used, their grey images, matched points
    road                 the road in both frames of a pair: heights of the cameras, roughly, and points
    calibrate            the entry point: reads a drive, measures in rounds, judges each camera and the whole rig
    in_turn              the same for a drive without poses, whose motion the wing `odometry` measures; the options of
                         `bevcli run` and `bevcli project-debug`
"""

from pathlib import Path

from bevcli.options import option, options


@options("Calibration")
class CalibrateOptions:
    """The assumptions of `calibrate`: standard deviations of what is stated, and how many frame pairs are used."""

    rotation_deg: float = option(
        default=2.0, help="How far off a stated rotation of a camera may be: standard deviation an axis, degrees.",
        minimum=0.01, maximum=10,
    )  # fmt: skip
    position_m: float = option(
        default=0.2, help="How far off a stated position of a camera may be: standard deviation an axis, metres.",
        minimum=0.001, maximum=2,
    )  # fmt: skip
    turn_deg: float = option(
        default=0.1, help="Error of the vehicle's stated rotation between two frames: standard deviation, degrees.",
        minimum=0.001, maximum=5,
    )  # fmt: skip
    scale: float = option(
        default=0.003, help="Error of the scale of the ego-motion: standard deviation, as a share.",
        minimum=0.0001, maximum=0.2,
    )  # fmt: skip
    pairs: int = option(default=24, help="Use at most this many pairs of frames.", minimum=8)


@options("Output")
class CalibrateOutputOptions:
    """The output folder of `bevcli calibrate`."""

    out: Path | None = option(default=None, help="Output folder. Default: runs/SEQUENCE-calibrate.", metavar="DIR")
