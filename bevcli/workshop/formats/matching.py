"""The images of cameras that do not fire together -> frames: each has the nearest image of every camera in time.

The first image of each camera, found by names alone, states cameras and image sizes that no file states. Cameras and
their folders may be named a little differently.
"""

import csv
import io
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.frame import FrameStamp
from bevcli.geometry.ego_motion import EgoMotion, nearest
from bevcli.parsing.documents import CSV_BYTES
from bevcli.parsing.files import IMAGE_SUFFIXES, MIB, VIDEO_SUFFIXES, is_there, read_bytes, read_text
from bevcli.parsing.images import size_of_image
from bevcli.printing import counted, name_of
from bevcli.sequences.images import FrameEntry, Source, open_capture
from bevcli.workshop.formats.camera_names import folder_of_images, match_names

FARTHEST = 0.501  # of a camera's period: an image farther from the frame than half of it belongs to another frame
GAP = 1.5  # periods from an image to the next where one was lost
MOST_LOST = 1000  # images in a row; a longer gap is a hole in the recording
SAME_RATE = 0.1  # measured periods that differ by less are the same
LARGEST_IMAGE = 256 * MIB
OTHERS = ("frame", "scene", "timestamp_ns")  # columns of frames.csv that are no cameras
Found = tuple[tuple[FrameEntry, ...], str]  # frames, and how they were understood


@dataclass(frozen=True)
class CameraImages:
    """The images of a camera."""

    name: str  # of the video or the folder, for messages
    times_ns: NDArray[np.int64]  # (N,) int64, increasing
    period_ns: float  # from one image to the next
    image: Callable[[int], Source]  # an image by its index
    is_uneven: bool = False  # the times are not evenly spaced, in a video

    def nearest(self, times_ns: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """(F,) the index of the image nearest to each time, and whether it is near enough to belong to it."""
        if not len(self.times_ns):
            return np.zeros(len(times_ns), dtype=np.int64), np.zeros(len(times_ns), dtype=np.bool_)
        indices = nearest(self.times_ns, times_ns)
        return indices, np.abs(self.times_ns[indices] - times_ns) <= FARTHEST * self.period_ns


def measured_periods(times: Mapping[str, NDArray[np.int64]]) -> dict[str, float]:
    """The period of each camera, ns: the median of its steps, and that of all cameras where these are about equal."""
    steps = {camera: np.diff(np.sort(stamps)) for camera, stamps in times.items() if len(stamps) > 1}
    if not steps:
        return dict.fromkeys(times, 1e9)
    common = float(np.median(np.concatenate(list(steps.values()))))
    periods = {camera: float(np.median(steps[camera])) if camera in steps else common for camera in times}
    return {camera: common if abs(period / common - 1) < SAME_RATE else period for camera, period in periods.items()}


def match(cameras: Mapping[str, CameraImages]) -> tuple[str, tuple[FrameEntry, ...]]:
    """The camera with the lowest rate, the first of equal ones, and a frame for each of its images.

    Where this camera lost images, the frames have those of the others.
    """
    leading, slowest = max(cameras.items(), key=lambda item: item[1].period_ns)
    return leading, frames_at(_without_gaps(slowest), cameras, leading)


def frames_at(times_ns: NDArray[np.int64], cameras: Mapping[str, CameraImages], leading: str) -> tuple[FrameEntry, ...]:
    """The frames at some times, with the nearest image of each camera. leading: the camera that errors name."""
    nearest = {camera: images.nearest(times_ns) for camera, images in cameras.items()}
    entries: list[FrameEntry] = []
    for row, time in enumerate(times_ns.tolist()):
        there = {camera: int(indices[row]) for camera, (indices, is_near) in nearest.items() if is_near[row]}
        if not there:
            continue
        sources = {camera: cameras[camera].image(index) for camera, index in there.items()}
        dropped = {
            camera: f"{images.name} has no image within {images.period_ns / 2e6:.0f} ms of {time} ns"
            for camera, images in cameras.items()
            if camera not in there
        }
        label = sources.get(leading, next(iter(sources.values())))
        entries.append(FrameEntry(FrameStamp(len(entries), "", time), sources, dropped, str(label)))
    return tuple(entries)


def _without_gaps(images: CameraImages) -> NDArray[np.int64]:
    """The times of a camera's images, and those of images that it lost between them."""
    times = images.times_ns
    steps = np.diff(times)
    counts = np.round(steps / images.period_ns).astype(np.int64)
    gaps = np.flatnonzero((steps > GAP * images.period_ns) & (counts <= MOST_LOST))
    lost = [times[gap] + steps[gap] * np.arange(1, counts[gap]) // counts[gap] for gap in gaps]
    return np.sort(np.concatenate([times, *lost]))


def covered(found: Found, motion: EgoMotion) -> Found:
    """The frames that the poses cover, if these are at least half of them; otherwise all, which is an error later."""
    entries, line = found
    kept = [entry for entry in entries if motion.covered(entry.times_ns).all()]
    if len(kept) == len(entries) or 2 * len(kept) < len(entries):
        return found
    return tuple(kept), f"{line}; {counted(len(entries) - len(kept), 'frames')} outside of the poses left out"


def first_images(drive: Path) -> dict[str, Path]:
    """The first image file or the video of each camera, by the camera's name.

    They are those of frames.csv, `images/CAMERA/*.jpg`, `videos/CAMERA.mp4` or `CAMERA/*.jpg`, the first of these that
    is there; of a drive that is a video, it is the video.
    """
    if drive.suffix.lower() in VIDEO_SUFFIXES and drive.is_file():
        return {drive.stem: drive}
    if is_there(drive / "frames.csv"):
        return _listed(drive / "frames.csv")
    for folder in (folder for folder in (drive / "images", drive / "videos", drive) if folder.is_dir()):
        videos = {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.lower() in VIDEO_SUFFIXES}
        folders = (path for path in sorted(folder.iterdir()) if path.is_dir())
        images = {path.name: image for path in folders if (image := _first_in(path)) is not None}
        if videos or images:
            return videos | images
    return {}


def cameras_with_images(cameras: Iterable[str], drive: Path | None) -> tuple[list[str], str]:
    """The cameras that have images in a drive, and a note on the others; "" where none is left out.

    All of them where the drive has other images too: a name may be misspelt.
    """
    cameras, found = list(cameras), {} if drive is None else first_images(drive)
    used = match_names(cameras, found)
    others = [name for name in cameras if name not in used]
    if not others or not used or len(used) < len(found):
        return cameras, ""
    return list(used), f"without images, left out: {', '.join(others)}"


def _listed(table: Path) -> dict[str, Path]:
    """The first cell of each camera's column in frames.csv. Nothing of a broken table, which its own reader refuses."""
    first_files, cameras = dict[str, Path](), list[str]()
    with suppress(csv.Error):
        rows = csv.reader(io.StringIO(read_text(table, CSV_BYTES).removeprefix("\ufeff"), newline=""))
        names = [name_of(cell.strip()) for cell in next(rows, [])]
        cameras = [name for name in names if name not in OTHERS and not name.endswith(".timestamp_ns")]
        for row in rows:
            cells = dict(zip(names, row, strict=False))
            first = {name: name_of(cells[name].strip()) for name in cameras if cells.get(name)}
            first_files = {name: table.parent / cell.partition("#")[0] for name, cell in first.items()} | first_files
            if len(first_files) == len(cameras):
                break
    return {name: first_files[name] for name in cameras if name in first_files}


def _first_in(folder: Path) -> Path | None:
    names = (path for path in folder_of_images(folder).iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    return min(names, default=None)


def size_of_first(drive: Path | None, camera: str) -> tuple[int, int] | None:
    """(width, height) in pixels of a camera's first image; None where it has none, or none that states a size.

    Raises InputError where the file cannot be read.
    """
    images = {} if drive is None else first_images(drive)
    path = images.get(match_names([camera], images).get(camera, ""))
    if path is None:
        return None
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return size_of_video(path)
    return size_of_image(read_bytes(path, LARGEST_IMAGE))


def size_of_video(path: Path) -> tuple[int, int]:
    """(width, height) of the images of a video, pixels. Raises InputError as `open_capture`."""
    capture = open_capture(path)
    width, height = (int(capture.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    capture.release()
    return width, height
