"""`open_sequence`: opens an input of any format as a drive, and selects a scene, a range of frames, a frame rate."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import DerivedDrive, Drive, Frame, FrameStamp
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.options import defaults, gather
from bevcli.sequences.files.boxes_file import ClassNames
from bevcli.sequences.format import check_options, drives_in, format_of, is_drive
from bevcli.sequences.options import InputOptions

# A scene counts as having the wanted rate if the ratio of its rate to it is in this range: keyframe times jitter.
SLOWEST_RATIO, FASTEST_RATIO = 0.75, 1.5
SHORTEST_PERIODS_NS = 3_000_000, 5_000_000  # between frames: a shorter one has a wrong unit; the right unit gives more
LONGEST_GAP_PERIODS = 1.5  # a longer gap between two frames, in periods of the wanted rate, is a hole in the recording


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
        for place, stamp in enumerate(drive.stamps):
            frame = drive.load(place)

    Only calibration, times and poses are read here, and with `odometry` all images. `load` decodes those of a frame.

    Args:
        path: the folder or file.
        options: the options of every format; None for the defaults.
        changes: options as keywords, those of `InputOptions` and those of the path's format: `RigOptions`,
            `NuScenesOptions`, `BagOptions`, `Argoverse2Options` and so on, or the options of an installed format.

    Raises InputError if the path has no known format, a file is missing or invalid, the format does not have an option,
    or no frame is left; TypeError for an option that no format has.
    """
    path, common = Path(path), defaults(InputOptions)
    options = gather(InputOptions, options, {name: changes.pop(name) for name in common if name in changes})
    if options.scene is not None and (drive := _drive_of(path, options.scene)):
        path, options = drive, replace(options, scene=None)
    if options.odometry:
        options = replace(options, ego_motion="measured")
    chosen = format_of(path)
    check_options(changes, [chosen], f"{path}: is {chosen.name}")
    own_defaults = defaults(chosen.options)
    own = gather(chosen.options, None, {name: value for name, value in changes.items() if name in own_defaults})
    sequence = chosen.open(path, options, own)
    check_time_unit(sequence, path)
    if options.ground_truth:
        sequence = WithClassNames(sequence, ClassNames(options.class_map, options.classes or NUSCENES_CLASSES))
    else:
        sequence = WithoutGroundTruth(sequence)
    if options.scene is not None:
        sequence = select_scene(sequence, options.scene)
    whole = sequence
    if options.every is not None:
        sequence = select_every(sequence, options.every)
    rate_hz = options.rate_hz
    if rate_hz is None and options.every is None and not own.wants_all_frames:
        rate_hz = options.model_rate_hz
    if rate_hz is not None and rate_hz != "all":
        sequence = select_rate(sequence, rate_hz)
    if options.frames is not None:
        sequence = select_range(sequence, options.frames)
    if not options.odometry:
        return sequence
    from bevcli.workshop.odometry.drives import with_measured_motion

    return with_measured_motion(sequence, whole, options.after_step)


def _drive_of(root: Path, name: str) -> Path | None:
    """A drive of a folder of drives by its name; None where the path is a drive itself, or holds none of this name."""
    return None if not root.is_dir() or is_drive(root) else drives_in(root).get(name)


class Selection(DerivedDrive):
    """The frames of another sequence at some of its indices."""

    def __init__(self, sequence: Drive, indices: Sequence[int], notes: tuple[str, ...] = ()) -> None:
        super().__init__(sequence)
        self._indices = tuple(indices)
        self.stamps = tuple(sequence.stamps[index] for index in self._indices)
        self.notes = (*sequence.notes, *notes)

    def image_files(self, index: int) -> tuple[Path, ...]:
        return self.sequence.image_files(self._indices[index])

    def ground_truth_frame(self, index: int) -> Frame:
        return self.sequence.ground_truth_frame(self._indices[index])

    def load(self, index: int) -> Frame:
        return self.sequence.load(self._indices[index])


class WithoutGroundTruth(DerivedDrive):
    """A sequence without its ground truth."""

    def load(self, index: int) -> Frame:
        return replace(super().load(index), ground_truth=None, ground_truth_map=None, ground_truth_results=())


class WithClassNames(DerivedDrive):
    """A sequence whose ground truth has the names of known classes, without impossible boxes; a note names others."""

    def __init__(self, sequence: Drive, names: ClassNames) -> None:
        super().__init__(sequence)
        self._names = names
        self.notes = (*sequence.notes, *names.note(sequence.class_counts, f"{sequence.name}: the ground truth"))

    @property
    def class_counts(self) -> Mapping[str, int]:
        counts: Counter[str] = Counter()
        for name, count in self.sequence.class_counts.items():
            counts[self._names[name]] += count
        return counts

    def ground_truth_frame(self, index: int) -> Frame:
        return self._renamed(self.sequence.ground_truth_frame(index))

    def load(self, index: int) -> Frame:
        return self._renamed(self.sequence.load(index))

    def _renamed(self, frame: Frame) -> Frame:
        truth = frame.ground_truth
        if truth is None:
            return frame
        kept = truth.possible()
        return replace(frame, ground_truth=self._names.renamed(kept), impossible_boxes=len(truth) - len(kept))


def check_time_unit(sequence: Drive, source: object) -> None:
    """Raise InputError where frames follow each other so fast that their times are no nanoseconds."""
    pairs = pairwise(sequence.stamps)
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


def select(sequence: Drive, indices: Sequence[int], notes: tuple[str, ...] = ()) -> Drive:
    """The frames of a sequence at `indices`. If these are all and `notes` is empty, the sequence itself.

    indices: positions in the sequence, from 0. notes: added to the sequence's own.
    """
    if not notes and list(indices) == list(range(len(sequence.stamps))):
        return sequence
    return Selection(sequence, indices, notes)


def select_scene(sequence: Drive, scene: str) -> Drive:
    """The frames of one scene. Raises InputError if the sequence does not have it."""
    indices = [index for index, stamp in enumerate(sequence.stamps) if stamp.scene == scene]
    if not indices:
        names = sorted({stamp.scene for stamp in sequence.stamps} - {""})
        scenes = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "") if names else "no scenes"
        raise InputError(f'{sequence.name}: has no scene "{scene}" (found {scenes})')
    return select(sequence, indices)


def select_range(sequence: Drive, frames: slice) -> Drive:
    """The frames in a range of positions, as Python slices a list. Raises InputError if there are none."""
    indices = range(len(sequence.stamps))[frames]
    if not indices:
        start, stop = ("" if end is None else end for end in (frames.start, frames.stop))
        count = len(sequence.stamps)
        raise InputError(f"`frames={start}:{stop}`: the range has no frame (the sequence has {count}: 0:{count})")
    return select(sequence, indices)


def select_every(sequence: Drive, step: int) -> Drive:
    """Every `step`-th frame of each scene, from the scene's first frame on."""
    return select(sequence, [index for scene in scenes_of(sequence.stamps) for index in scene[::step]])


def select_rate(sequence: Drive, rate_hz: float) -> Drive:
    """The sequence thinned to about `rate_hz` frames per second, scene by scene.

    A model expects the frame rate that it was trained with: its velocities and its history depend on it. In each
    scene, the frames nearest to a regular clock that starts at the scene's first frame are kept. A scene that has
    about this rate, or a lower one, is kept whole. `notes` tell the user what was done.
    """
    stamps = sequence.stamps
    kept: list[int] = []
    slowest = np.inf
    for indices in scenes_of(stamps):
        times = np.array([stamps[index].timestamp_ns for index in indices], dtype=np.int64)
        ratio = float(1e9 / np.median(np.diff(times))) / rate_hz if len(times) > 1 else np.inf
        slowest = min(slowest, ratio)
        chosen = _nearest_to_clock(times, rate_hz) if ratio > FASTEST_RATIO else range(len(indices))
        kept += [indices[position] for position in chosen]
    notes = []
    if len(kept) < len(stamps):
        notes.append(
            f"{len(kept)} of {len(stamps)} frames are used, at about {rate_hz:g} frames per second "
            '(`rate_hz="all"` uses every frame)'
        )
    if slowest < SLOWEST_RATIO:
        notes.append(
            f"the input has {slowest * rate_hz:.2g} frames per second, fewer than the model's {rate_hz:g}: "
            "velocities will be less accurate and history less useful"
        )
    return select(sequence, kept, tuple(notes))


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
    later = np.clip(np.searchsorted(seconds, ticks), 1, len(seconds) - 1)
    earlier = later - 1
    return np.unique(np.where(ticks - seconds[earlier] <= seconds[later] - ticks, earlier, later))
