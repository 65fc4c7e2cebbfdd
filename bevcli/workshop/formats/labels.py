"""LabelFormat: a format of labels, registered under `bevcli.label_formats`; a drive with the boxes of such a file."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence as Items
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import DerivedSequence, Frame, FrameStamp, Sequence
from bevcli.geometry.boxes import IMPOSSIBLE, Boxes3D, velocities_between
from bevcli.geometry.cameras import CameraRig
from bevcli.printing import counted
from bevcli.registry import entries, load
from bevcli.sequences.files.boxes_file import count_classes
from bevcli.sequences.open import scenes_of
from bevcli.workshop.formats import LabelOptions, UnlistedFrames

GROUP = "bevcli.label_formats"
NEAREST_NS = 50_000_000  # largest difference between the time of a frame and of its labels
FrameOfReference = Literal["world", "ego", "bev"]
Moment = tuple[int | None, int | None]  # index and time of a frame, ns, as in LabelledFrame


@dataclass(frozen=True)
class LabelledFrame:
    """The boxes of one frame.

    Attributes:
        index: of the frame; None if the file has times only.
        timestamp_ns: of the frame; None if the file has indices only.
        boxes: in the frame of reference of the file.
    """

    index: int | None
    timestamp_ns: int | None
    boxes: Boxes3D


@dataclass(frozen=True)
class Labels:
    """The contents of a file of labels.

    Attributes:
        frame_of_reference: of all boxes.
        frames: in the order of the file.
        lists_empty: frames without boxes are in the file, too. If not, a frame of the drive that the file does not
            have may be empty or not labelled.
        notes: what was assumed, for the user.
    """

    frame_of_reference: FrameOfReference
    frames: tuple[LabelledFrame, ...]
    lists_empty: bool
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class LabelFormat:
    """A format of labels.

    Attributes:
        name: with an article, for messages.
        recognises: whether a file has this format; looks at its name, or at a few bytes.
        read: reads a file of a drive with this rig. Raises InputError.
    """

    name: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path, CameraRig, LabelOptions], Labels]


def read_labels(path: Path, rig: CameraRig, options: LabelOptions) -> Labels:
    """The labels of a file of any known format. rig: of the drive. Raises InputError."""
    known: list[LabelFormat] = [load(GROUP, name) for name in entries(GROUP)]
    found = next((form for form in known if form.recognises(path)), None)
    if found is None:
        raise InputError(f"{path}: is no file of labels (expected {' or '.join(form.name for form in known)})")
    labels = found.read(path, rig, options)
    frames = tuple(replace(labelled, boxes=labelled.boxes.possible()) for labelled in labels.frames)
    left_out = sum(len(labelled.boxes) for labelled in labels.frames) - sum(len(labelled.boxes) for labelled in frames)
    note = (f"{counted(left_out, 'boxes')} {IMPOSSIBLE}",) if left_out else ()
    return replace(labels, frames=frames, notes=(*labels.notes, *note))


class WithLabels(DerivedSequence):
    """A drive whose boxes are those of a file of labels; a map of the drive is kept.

    Labels belong to the frame of the same time, or, where the file has no times, of the same index. Where the file has
    tracks and no velocities, velocities follow from the positions before and after.

    options: of the labels, whose file is `path`.

    Raises InputError where the file cannot be read, or where not all of its frames are in the drive.
    """

    def __init__(self, sequence: Sequence, path: Path, options: LabelOptions = LabelOptions()) -> None:
        super().__init__(sequence)
        labels = read_labels(path, sequence.rig, options)
        if labels.frame_of_reference == "world" and not sequence.has_ego_motion:
            raise InputError(f"{path}: its boxes are in the world frame, but the drive has no ego_motion.csv: add it")
        boxes, note = _with_velocities(sequence, _in_world(sequence, labels, path))
        unlisted = "unlabelled" if labels.lists_empty else options.unlisted_frames
        labelled = _labelled_places(sequence.stamps, boxes, unlisted)
        self._listed, self._boxes = len(boxes), {place: Boxes3D.empty() for place in labelled} | boxes
        notes = (*labels.notes, *note, self._summary())
        self.notes = (*sequence.notes, *(f"{path}: {text}" for text in notes))

    @property
    def class_counts(self) -> Mapping[str, int]:
        return count_classes(self._boxes.values())

    def ground_truth_frame(self, place: int) -> Frame:
        return self._labelled(self.sequence.ground_truth_frame(place), place)

    def load(self, place: int) -> Frame:
        return self._labelled(self.sequence.load(place), place)

    def _labelled(self, frame: Frame, place: int) -> Frame:
        return replace(frame, ground_truth=self._boxes.get(place), impossible_boxes=0)

    def _summary(self) -> str:
        counts = ", ".join(f"{name} ({count})" for name, count in sorted(self.class_counts.items()))
        parts = [f"{counted(self._listed, 'frames')} with labels: {counts or 'none'}"]
        empty, unlabelled = len(self._boxes) - self._listed, len(self.stamps) - len(self._boxes)
        if empty:
            parts.append(f"{empty} frames without rows are empty (see `unlisted_frames`)")
        if unlabelled:
            parts.append(f"{unlabelled} frames are not labelled: they have no ground truth")
        return "; ".join(parts)


def _labelled_places(stamps: Items[FrameStamp], listed: Collection[int], unlisted: UnlistedFrames | None) -> set[int]:
    """The places of labelled frames, with or without boxes.

    If a file lists no two successive frames, the labelling tool was given every n-th frame of a scene: the largest n
    that all listed frames fit. Otherwise every frame is labelled.

    listed: the places that the file has. unlisted: the user's choice for the others; None to decide as above.
    """
    scenes = list(scenes_of(stamps))
    if unlisted == "unlabelled":
        return set(listed)
    if unlisted == "empty" or any(a in listed and b in listed for scene in scenes for a, b in pairwise(scene)):
        return set(range(len(stamps)))
    labelled: set[int] = set()
    for scene in scenes:
        found = [number for number, place in enumerate(scene) if place in listed]
        step = math.gcd(*(other - one for one, other in pairwise(found))) or len(scene)
        labelled.update(scene[found[0] % step :: step] if found else ())
    return labelled


def _in_world(sequence: Sequence, labels: Labels, path: Path) -> dict[int, Boxes3D]:
    """The boxes in the world frame, by place of the frame in the drive."""
    times = np.array([stamp.timestamp_ns for stamp in sequence.stamps], dtype=np.int64)
    places = {stamp.index: place for place, stamp in enumerate(sequence.stamps)}
    found: dict[int, Boxes3D] = {}
    for labelled in labels.frames:
        place = _place(labelled, times, places)
        if place is None:
            raise InputError(
                f"{path}: {_words(labelled)} is not in the drive (expected indices {min(places)} to {max(places)}, "
                f"times {times.min()} to {times.max()} ns): are these the labels of this drive?"
            )
        if place in found:
            raise InputError(f"{path}: {_words(labelled)}: its frame of the drive has labels already")
        boxes = labelled.boxes
        if labels.frame_of_reference != "world" and len(boxes):
            frame = sequence.ground_truth_frame(place)
            boxes = boxes.transformed(frame.rig.ego_from_bev) if labels.frame_of_reference == "bev" else boxes
            boxes = boxes.transformed(frame.world_from_ego.matrix)
        found[place] = boxes
    return found


def _with_velocities(sequence: Sequence, boxes: dict[int, Boxes3D]) -> tuple[dict[int, Boxes3D], tuple[str, ...]]:
    """The boxes by place, with the velocities of their tracks if none is known, and a note."""
    together = Boxes3D.concatenate(boxes.values())
    if not len(together) or np.isfinite(together.velocities).any():
        return boxes, ()
    if together.instances is None or not sequence.has_ego_motion:
        needed = "a column `instance`" if together.instances is None else "ego-motion"
        return boxes, (f"the velocities of the boxes are not known ({needed} would give them): no box code is trained",)
    filled: dict[int, Boxes3D] = {}
    for _, scene in groupby(sorted(boxes), key=lambda place: sequence.stamps[place].scene):
        places = list(scene)
        times = [sequence.stamps[place].timestamp_ns for place in places]
        filled |= zip(places, with_track_velocities([boxes[place] for place in places], times), strict=True)
    return filled, ("velocities follow from the tracks",)


def _place(labelled: LabelledFrame, times: np.ndarray, places: Mapping[int, int]) -> int | None:
    if labelled.timestamp_ns is None:
        return None if labelled.index is None else places.get(labelled.index)
    nearest = int(np.abs(times - labelled.timestamp_ns).argmin())
    return nearest if abs(int(times[nearest]) - labelled.timestamp_ns) <= NEAREST_NS else None


def _words(labelled: LabelledFrame) -> str:
    time = "" if labelled.timestamp_ns is None else f" at {labelled.timestamp_ns} ns"
    return f"the frame{'' if labelled.index is None else f' {labelled.index}'}{time}"


def with_track_velocities(frames: Items[Boxes3D], timestamps_ns: Items[int]) -> list[Boxes3D]:
    """The boxes of T frames, in the world frame, with the velocities that follow from their `instances`; "" is none.

    timestamps_ns: (T,) increasing.
    """
    together = Boxes3D.concatenate(frames)
    if together.instances is None:
        return list(frames)
    counts = [len(boxes) for boxes in frames]
    seconds = np.repeat((np.asarray(timestamps_ns) - timestamps_ns[0]) * 1e-9, counts)
    order = np.lexsort((seconds, together.instances))
    names = together.instances[order]
    same = (names[1:] == names[:-1]) & (names[1:] != "")
    first, last = np.arange(len(order)), np.arange(len(order))
    first[order[1:][same]], last[order[:-1][same]] = order[:-1][same], order[1:][same]
    velocities = velocities_between(together.centers, seconds, first, last)[:, :2]
    parts = np.split(velocities, np.cumsum(counts)[:-1])
    return [replace(boxes, velocities=own) for boxes, own in zip(frames, parts, strict=True)]
