"""The native sequence folder: one drive with calibration, images or videos, ego-motion and ground truth.

Its frames where it has no frames.csv are found by `bevcli.workshop.formats.unlisted`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from bevcli.errors import InputError
from bevcli.options import option, options
from bevcli.sequences.format import Format
from bevcli.sequences.options import RigOptions, TimeUnit

# Any of these makes a folder a native sequence, so that an incomplete one gets an error that names the missing file.
MARKERS = ("calibration.json", "frames.csv", "ego_motion.csv", "images", "videos")
# Seconds and their parts, a date with a time of day, or the index of an image.
TimeKind = Literal[TimeUnit, "date", "index"]
RATES_HZ = (0.001, 10_000.0)
LARGEST_NS = 1 << 61  # of a stated time, so that sums have 64 bits


def holds_videos_alone(path: Path) -> bool:
    """True for a folder of videos with no other part of a drive, which may do without poses as a single video may."""
    return [name for name in MARKERS if (path / name).exists()] == ["videos"]


@options("Input")
class FolderOptions(RigOptions):
    """The rig, and the times of images that no frames.csv lists."""

    times: TimeKind | None = option(
        default=None, help="What the numbers in image names are, without frames.csv. Default: found from the numbers."
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
        slowest, fastest = RATES_HZ
        if self.image_rate_hz is not None and not slowest <= self.image_rate_hz <= fastest:
            raise InputError(
                f"`image_rate_hz={self.image_rate_hz:g}` (`--image-rate`): expected images per second, {slowest:g} or "
                "more"
            )
        if self.start_ns is not None and abs(self.start_ns) > LARGEST_NS:
            raise InputError(f"`start_ns={self.start_ns}` (`--start-ns`): expected nanoseconds, at most {LARGEST_NS}")


@options("Input")
class NativeFolder(FolderOptions, Format):
    """A native sequence folder."""

    name = "a sequence folder"
    expected = "calibration.json, frames.csv, ego_motion.csv, images or videos"
    reader = "bevcli.sequences.native.folder:FolderDrive"
    precedence = -10

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """True for a folder with a file or folder of a native sequence, or with folders that are named like cameras."""
        if any((path / name).exists() for name in MARKERS):
            return True
        from bevcli.workshop.formats.camera_names import has_camera_folders

        return has_camera_folders(path)
