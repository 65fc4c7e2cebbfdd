"""The futures of true objects: the places where the same objects are in later frames of the ground truth."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.sequences.files.boxes_file import FrameBoxes

LATE_S = 0.1  # a frame this near counts as one at the time of a step


class Drives:
    """The frames of a ground truth by scene and time, with boxes in the world frame."""

    def __init__(self, truth: Iterable[FrameBoxes]) -> None:
        self._scenes: dict[str, list[FrameBoxes]] = {}
        for frame in truth:
            self._scenes.setdefault(frame.stamp.scene, []).append(frame)
        for frames in self._scenes.values():
            frames.sort(key=lambda frame: frame.stamp.timestamp_ns)
        self._times = {
            scene: np.array([frame.stamp.timestamp_ns for frame in frames]) for scene, frames in self._scenes.items()
        }

    def after(self, stamp: FrameStamp, seconds: float) -> FrameBoxes | None:
        """The frame of the same scene so many seconds later; None where there is none within LATE_S."""
        wanted = stamp.timestamp_ns + round(seconds * 1e9)
        times = self._times[stamp.scene]
        nearest = int(np.abs(times - wanted).argmin())
        return self._scenes[stamp.scene][nearest] if abs(times[nearest] - wanted) <= LATE_S * 1e9 else None


def with_true_futures(boxes: Boxes3D, stamp: FrameStamp, drives: Drives, times_s: Sequence[float] | Array) -> Boxes3D:
    """Boxes in the world frame with one future each: NaN from the first step on in which the object is not there.

    Raises InputError where the boxes have no identities.
    """
    if len(boxes) and boxes.instances is None:
        raise InputError(f'frame {stamp.index}: true boxes have no "instance": futures need identities')
    places = np.full((len(boxes), 1, len(times_s), 2), np.nan)
    alive = np.ones(len(boxes), dtype=bool)
    for step, seconds in enumerate(times_s):
        frame = drives.after(stamp, seconds)
        later = Boxes3D.empty() if frame is None else frame.boxes
        names = () if later.instances is None else later.instances
        row_of = {name: row for row, name in enumerate(names) if name}
        for place, name in enumerate(() if boxes.instances is None else boxes.instances):
            alive[place] &= name in row_of
            if alive[place]:
                places[place, 0, step] = later.centers[row_of[name], :2]
    seconds = np.broadcast_to(np.asarray(times_s)[:, None], (*places.shape[:3], 1))
    return replace(boxes, futures=np.concatenate([seconds, places], axis=-1))
