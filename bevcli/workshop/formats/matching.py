"""Images of cameras that do not fire together -> frames: each has the image of every camera that is nearest in time."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.frame import FrameStamp
from bevcli.geometry.ego_motion import EgoMotion, nearest
from bevcli.printing import counted
from bevcli.sequences.images import FrameEntry, Source

FARTHEST = 0.501  # of a camera's period: an image farther from the frame than half of it belongs to another frame
GAP = 1.5  # periods from an image to the next where one was lost
MOST_LOST = 1000  # images in a row; a longer gap is a hole in the recording
SAME_RATE = 0.1  # measured periods that differ by less are the same
Found = tuple[tuple[FrameEntry, ...], str]  # frames, and how they were understood


@dataclass(frozen=True)
class CameraImages:
    """The images of a camera.

    Attributes:
        name: of the video or the folder, for messages.
        times_ns: (N,) int64, increasing.
        period_ns: from one image to the next.
        image: an image by its index.
        is_uneven: the times are not evenly spaced, in a video.
    """

    name: str
    times_ns: NDArray[np.int64]
    period_ns: float
    image: Callable[[int], Source]
    is_uneven: bool = False

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
