"""The options of a native sequence folder: beside those of the rig, what the names of images do not state."""

from __future__ import annotations

from typing import Literal

from bevcli.errors import InputError
from bevcli.options import option, options
from bevcli.sequences.options import RigOptions

# Seconds and their parts, a date with a time of day, or the index of an image.
TimeKind = Literal["s", "ms", "us", "ns", "date", "index"]


@options("Input")
class FolderOptions(RigOptions):
    """The rig, and the times of images that no frames.csv lists."""

    times: TimeKind | None = option(
        default=None,
        help="What the numbers in image names are, without frames.csv. Default: found from the numbers.",
    )
    image_rate_hz: float | None = option(
        default=None,
        help="Images per second of numbered images and videos, without frames.csv; as rate_hz in timing.toml.",
        flag="--image-rate",
        metavar="HZ",
    )
    start_ns: int | None = option(
        default=None,
        help="Time of the first numbered image or of the videos, nanoseconds, without frames.csv; as in timing.toml.",
    )

    def __post_init__(self) -> None:
        if self.image_rate_hz is not None and not 0 < self.image_rate_hz < 10_000:
            raise InputError(f"`image_rate_hz={self.image_rate_hz:g}`: expected images per second, above 0")
