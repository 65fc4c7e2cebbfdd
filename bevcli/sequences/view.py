"""DriveView: frames of a drive, with other class names, another rig or other poses; and the choice of frames."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import groupby
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import DerivedDrive, Drive, Frame, FrameStamp
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import EgoMotion, nearest
from bevcli.geometry.transforms import inverse
from bevcli.sequences.files.boxes_file import ClassNames, count_classes

# A scene counts as having the wanted rate if the ratio of its rate to it is in this range: keyframe times jitter.
SLOWEST_RATIO, FASTEST_RATIO = 0.75, 1.5
LONGEST_GAP_PERIODS = 1.5  # a longer gap between two frames, in periods of the wanted rate, is a hole in the recording


class DriveView(DerivedDrive):
    """Frames of a drive as they are used. A view of a view is a view of the drive below.

    Args:
        drive: a drive or a view.
        indices: of the frames in it; None for all.
        names: of the classes of the ground truth. Impossible boxes are left out.
        has_truth: False for a view without ground truth.
        rig: of every frame, in place of its own.
        motions: scene -> measured poses, which also move the ground truth. Empty for the poses of the drive.
        notes: added to those of the drive.
    """

    def __init__(
        self,
        drive: Drive,
        indices: Sequence[int] | None = None,
        *,
        names: ClassNames | None = None,
        has_truth: bool = True,
        rig: CameraRig | None = None,
        motions: Mapping[str, EgoMotion] | None = None,
        notes: tuple[str, ...] = (),
    ) -> None:
        super().__init__(drive)
        self._indices = tuple(range(len(drive.stamps)) if indices is None else indices)
        self.stamps, self.notes = tuple(drive.stamps[index] for index in self._indices), (*drive.notes, *notes)
        self._names, self._has_truth, self._rig, self._motions = names, has_truth, rig, motions
        if isinstance(drive, DriveView):
            assert names is None or drive._names is None, "classes are renamed once"
            self.drive, self._indices = drive.drive, tuple(drive._indices[index] for index in self._indices)
            self._names, self._has_truth = names or drive._names, has_truth and drive._has_truth
            self._rig, self._motions = rig or drive._rig, motions or drive._motions
        self.rig = rig or drive.rig
        if motions:
            self.has_ego_motion, self.ego_motion = True, next(iter(motions.values())) if len(motions) == 1 else None
            self.facts = replace(drive.facts, geo_origin=None, motion_measured=True)

    @cached_property
    def class_counts(self) -> Mapping[str, int]:
        counts = self.drive.class_counts if self._has_truth else {}
        if counts and len(self._indices) < len(self.drive.stamps):
            counts = count_labels(self.drive, self._indices)
        return counts if self._names is None else self._names.counts(counts)

    def image_files(self, index: int) -> tuple[Path, ...]:
        return self.drive.image_files(self._indices[index])

    def ground_truth_frame(self, index: int) -> Frame:
        return self._viewed(self.drive.ground_truth_frame(self._indices[index]))

    def load(self, index: int) -> Frame:
        return self._viewed(self.drive.load(self._indices[index]))

    def _viewed(self, frame: Frame) -> Frame:
        truth = frame.ground_truth
        if not self._has_truth:
            frame = replace(frame, ground_truth=None, ground_truth_map=None, ground_truth_results=())
        elif truth is not None and self._names is not None:
            possible = truth.possible()
            left_out = len(truth) - len(possible)
            frame = replace(frame, ground_truth=self._names.renamed(possible), impossible_boxes=left_out)
        if self._rig is not None:
            frame = replace(frame, rig=self._rig)
        return _moved(frame, self._motions[frame.stamp.scene]) if self._motions else frame


def count_labels(drive: Drive, indices: Iterable[int] | None = None) -> Mapping[str, int]:
    """Number of ground-truth boxes by class in some frames of a drive, or in all: of its table where it has one."""
    if indices is None and drive.class_counts:
        return drive.class_counts
    truths = (drive.ground_truth_frame(index).ground_truth for index in indices or range(len(drive.stamps)))
    return count_classes(boxes for boxes in truths if boxes is not None)


def _moved(frame: Frame, motion: EgoMotion) -> Frame:
    """The frame with other poses and kinematics. Its ground truth in the world frame is moved with the vehicle."""
    time, truth = frame.stamp.timestamp_ns, frame.ground_truth
    times = {name: frame.images[name].timestamp_ns if name in frame.images else time for name in frame.rig.names}
    pose = motion.pose_at(time)
    moved = pose.matrix @ inverse(frame.world_from_ego.matrix)
    return replace(
        frame,
        world_from_ego=pose,
        ground_truth=None if truth is None else truth.transformed(moved),
        world_from_ego_at={name: motion.pose_at(image_time) for name, image_time in times.items()},
        kinematics=motion.kinematics_at(time),
        road_normal=motion.road_normal_at(time),
        sample_token=None,  # of a submission, whose boxes are in the world of nuScenes
    )


def select(drive: Drive, indices: Sequence[int], notes: tuple[str, ...] = ()) -> Drive:
    """The frames of a drive at `indices`. If these are all and `notes` is empty, the drive itself.

    indices: positions in the drive, from 0. notes: added to the drive's own.
    """
    if not notes and list(indices) == list(range(len(drive.stamps))):
        return drive
    return DriveView(drive, indices, notes=notes)


def select_scene(drive: Drive, scene: str) -> Drive:
    """The frames of one scene. Raises InputError if the drive does not have it."""
    indices = [index for index, stamp in enumerate(drive.stamps) if stamp.scene == scene]
    if not indices:
        names = sorted({stamp.scene for stamp in drive.stamps} - {""})
        scenes = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "") if names else "no scenes"
        raise InputError(f'{drive.name}: has no scene "{scene}" (found {scenes})')
    return select(drive, indices)


def select_range(drive: Drive, frames: slice) -> Drive:
    """The frames in a range of positions, as Python slices a list. Raises InputError if there are none."""
    indices = range(len(drive.stamps))[frames]
    if not indices:
        start, stop = ("" if end is None else end for end in (frames.start, frames.stop))
        count = len(drive.stamps)
        raise InputError(
            f"`frames={start}:{stop}` (`--frames`): the range has no frame (the sequence has {count}: 0:{count})"
        )
    return select(drive, indices)


def select_every(drive: Drive, step: int) -> Drive:
    """Every `step`-th frame of each scene, from the scene's first frame on."""
    return select(drive, [index for scene in scenes_of(drive.stamps) for index in scene[::step]])


def select_rate(drive: Drive, rate_hz: float) -> Drive:
    """The drive thinned to about `rate_hz` frames per second, scene by scene.

    A model expects the frame rate that it was trained with: its velocities and its history depend on it. In each
    scene, the frames nearest to a regular clock that starts at the scene's first frame are kept. A scene that has
    about this rate, or a lower one, is kept whole. `notes` tell the user what was done.
    """
    stamps = drive.stamps
    kept: list[int] = []
    slowest = np.inf
    for indices in scenes_of(stamps):
        times = np.array([stamps[index].timestamp_ns for index in indices], dtype=np.int64)
        ratio = float(1e9 / np.median(np.diff(times))) / rate_hz if len(times) > 1 else np.inf
        slowest = min(slowest, ratio)
        positions = _nearest_to_clock(times, rate_hz) if ratio > FASTEST_RATIO else range(len(indices))
        kept += [indices[position] for position in positions]
    notes = []
    if len(kept) < len(stamps):
        notes.append(
            f"{len(kept)} of {len(stamps)} frames are used, at about {rate_hz:g} frames per second "
            '(`rate_hz="all"` (`--rate all`) uses every frame)'
        )
    if slowest < SLOWEST_RATIO:
        notes.append(
            f"the input has {slowest * rate_hz:.2g} frames per second, fewer than the model's {rate_hz:g}: "
            "velocities will be less accurate and history less useful"
        )
    return select(drive, kept, tuple(notes))


def scenes_of(stamps: Sequence[FrameStamp]) -> Iterator[list[int]]:
    """The indices of each scene: a run of consecutive frames with the same scene name."""
    for _, indices in groupby(range(len(stamps)), key=lambda index: stamps[index].scene):
        yield list(indices)


def _nearest_to_clock(times_ns: np.ndarray, rate_hz: float) -> list[int]:
    """Indices of the frames nearest to the ticks of the clock, which restarts after a hole in the recording."""
    seconds = (times_ns - times_ns[0]) / 1e9
    holes = np.flatnonzero(np.diff(seconds) > LONGEST_GAP_PERIODS / rate_hz) + 1
    kept: list[int] = []
    for piece in np.split(np.arange(len(seconds)), holes):
        kept += (piece[0] + _nearest_in_piece(seconds[piece] - seconds[piece[0]], rate_hz)).tolist()
    return kept


def _nearest_in_piece(seconds: np.ndarray, rate_hz: float) -> np.ndarray:
    if len(seconds) == 1:
        return np.zeros(1, dtype=np.int64)
    # A tick later than half a frame period after the last frame has no frame of its own.
    end = seconds[-1] + 0.5 * np.median(np.diff(seconds))
    ticks = np.arange(0, end, 1 / rate_hz)
    return np.unique(nearest(seconds, ticks))
