"""`open_sequence`: opens an input of any format as a drive, and selects a scene, a range of frames, a frame rate."""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import DerivedDrive, Drive, Frame, FrameStamp
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import EgoMotion, nearest
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.geometry.transforms import inverse
from bevcli.options import defaults, gather
from bevcli.sequences.files.boxes_file import ClassNames, count_classes
from bevcli.sequences.format import check_options, drives_in, format_of, is_drive
from bevcli.sequences.options import InputOptions

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


SHORTEST_PERIODS_NS = 3_000_000, 5_000_000  # between frames: a shorter one has a wrong unit; the right unit gives more


def open_sequence(path: str | Path, options: InputOptions | None = None, **changes: Any) -> Drive:
    """Open a drive.

    It is a native sequence folder (images or videos), a nuScenes dataset root, an MCAP file, a ROS 2 bag, or a drive of
    another data set (docs/other-inputs.md).

        drive = open_sequence("my_drive")
        drive = open_sequence("drive.mcap", calibration="calibration.json")
        drive = open_sequence("my_drive", rate_hz=2.0, frames=slice(0, 40))
        drive = open_sequence("nuscenes", version="v1.0-mini", scene="scene-0103")
        drive = open_sequence("ddad_train_val", scene="000150")  # a folder of drives
        drive = open_sequence("dash.mp4", fov_deg=70, height=1.4, odometry=True)  # poses measured from the images
        for index in range(len(drive.stamps)):
            frame = drive.load(index)

    Only calibration, times and poses are read here, and with `odometry` all images. `load` decodes those of a frame.

    Args:
        path: the folder or file.
        options: the options of every format; None for the defaults.
        changes: options as keywords, those of `InputOptions` and those of the path's format: `RigOptions`,
            `NuScenesOptions`, `BagOptions`, `Argoverse2Options` and so on, or the options of an installed format.

    Raises InputError if the path has no known format, a file is missing or invalid, the format does not have an option,
    or no frame is left; TypeError for an option that no format has.
    """
    drive: Drive = deque[Any](open_steps(path, options, **changes), maxlen=1).pop()
    return drive


def open_steps(
    path: str | Path, options: InputOptions | None = None, **changes: Any
) -> Iterator[tuple[int, int] | Drive]:
    """Open a drive as `open_sequence`: the drive at the end.

    Before it, with `odometry`, the number of steps that are measured and of all, scene by scene.
    """
    path, common = Path(path), defaults(InputOptions)
    options = gather(InputOptions, options, {name: changes.pop(name) for name in common if name in changes})
    if options.scene is not None and (named := _drive_of(path, options.scene)):
        path, options = named, replace(options, scene=None)
    if options.odometry:
        options = replace(options, ego_motion="measured")
    opened = format_of(path)
    check_options(changes, [opened], f"{path}: is {opened.name}")
    made = gather(opened, None, {name: value for name, value in changes.items() if name in defaults(opened)})
    drive = made.open(path, options)
    if not drive.rig.cameras:
        raise InputError(f"{path}: {drive.name}: the rig has no camera (expected one or more)")
    check_time_unit(drive, path)
    if options.ground_truth:
        names = ClassNames(options.class_map, options.classes or NUSCENES_CLASSES)
        note = names.note(drive.class_counts, f"{drive.name}: the ground truth")
        drive = DriveView(drive, names=names, notes=note)
    else:
        drive = DriveView(drive, has_truth=False)
    if options.scene is not None:
        drive = select_scene(drive, options.scene)
    whole = drive
    if options.every is not None:
        drive = select_every(drive, options.every)
    rate_hz = options.rate_hz
    if rate_hz is None and options.every is None and not made.wants_all_frames:
        rate_hz = options.model_rate_hz
    if rate_hz is not None and rate_hz != "all":
        drive = select_rate(drive, rate_hz)
    if options.frames is not None:
        drive = select_range(drive, options.frames)
    if options.odometry:
        from bevcli.workshop.odometry.report import with_measured_motion

        yield from with_measured_motion(drive, whole)
    else:
        yield drive


def _drive_of(root: Path, name: str) -> Path | None:
    """A drive of a folder of drives by its name; None where the path is a drive itself, or holds none of this name."""
    return None if not root.is_dir() or is_drive(root) else drives_in(root).get(name)


def check_time_unit(drive: Drive, source: object) -> None:
    """Raise InputError where frames follow each other so fast that their times are no nanoseconds."""
    pairs = pairwise(drive.stamps)
    periods = [after.timestamp_ns - before.timestamp_ns for before, after in pairs if before.scene == after.scene]
    period = (np.median(periods) or np.mean(periods)) if periods else np.inf
    if period < SHORTEST_PERIODS_NS[0]:
        # In place of nanoseconds, or of microseconds as in nuScenes' tables.
        units = {10**3: "microseconds or milliseconds", 10**6: "milliseconds or seconds", 10**9: "seconds"}
        factor = next((multiple for multiple in units if period * multiple >= SHORTEST_PERIODS_NS[1]), 10**9)
        raise InputError(
            f"{source}: the timestamps are {factor} times too small (in {units[factor]}?): the frames are {period:.0f} "
            f"ns apart (expected {SHORTEST_PERIODS_NS[0]} or more): multiply all times"
        )
