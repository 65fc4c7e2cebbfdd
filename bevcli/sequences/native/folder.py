"""The native sequence folder as a Sequence."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from bevcli.errors import InputError
from bevcli.frame import DriveFacts, Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import TOLERANCE_NS, EgoMotion
from bevcli.geometry.transforms import Pose
from bevcli.parsing.files import is_there
from bevcli.sequences.files.boxes_file import BoxesFile, read_boxes
from bevcli.sequences.files.calibration_file import read_rig_and_facts
from bevcli.sequences.files.class_names import count_classes
from bevcli.sequences.files.incremental_json import existing
from bevcli.sequences.files.map_folder import open_maps
from bevcli.sequences.format import true_results
from bevcli.sequences.images import FrameEntry, ImageSource, ListedSequence, leads_out, read_frame
from bevcli.sequences.native.tables import check_times, read_ego_motion, read_frames_table
from bevcli.sequences.native.unlisted_frames import find_frames
from bevcli.sequences.options import EgoMotionUse, RigOptions, SequenceOptions
from bevcli.sequences.video import rotation_notes

BOXES_FILE = "ground_truth.json"
MAPS_FOLDER = "ground_truth_map"


class FolderSequence(ListedSequence):
    """A native sequence folder as a `Sequence`.

    rig: used in place of the rig of `own` and of calibration.json, if given.
    Raises InputError if a file of the folder is missing or invalid.
    """

    def __init__(
        self,
        path: Path,
        common: SequenceOptions = SequenceOptions(),
        own: RigOptions = RigOptions(),
        rig: CameraRig | None = None,
    ) -> None:
        if not path.is_dir():
            raise InputError(f"{path}: the sequence folder is missing")
        self.path, self.name = path, path.resolve().name
        rig = own.rig() if rig is None else rig
        calibration = path / "calibration.json"
        self.rig, self.facts = read_rig_and_facts(calibration) if rig is None else (rig, DriveFacts())
        entries, notes = _read_entries(path, self.rig)
        self._list(entries, path, common)
        if not common.allow_outside:
            _check_paths(path, entries)
        file = own.ego_motion_file or path / "ego_motion.csv"
        self.ego_motion, motion_notes = _read_motion(file, common.ego_motion)
        if self.ego_motion is not None:
            advice = "set start_ns in timing.toml" if notes else "add ego-motion, or remove the frame"
            _check_coverage(file, self.ego_motion, entries, advice)
        self.has_ego_motion = self.ego_motion is not None
        self._read_truth(is_read=common.ground_truth)
        sources = [one for entry in entries for one in entry.sources.values() if isinstance(one, ImageSource)]
        turned = rotation_notes(sorted({one.path for one in sources if one.video_index is not None}))
        self.notes = (*rig_notes(self.rig), *notes, *motion_notes, *turned)

    def _read_truth(self, *, is_read: bool) -> None:
        """Read ground_truth.json and files of further results; maps are read frame by frame. Each may be missing."""
        boxes, maps = self.path / BOXES_FILE, self.path / MAPS_FOLDER
        self._boxes = read_boxes(boxes) if is_read and is_there(existing(boxes)) else BoxesFile("ego", ())
        self._true_results = true_results("native", self.path) if is_read else ()
        self._maps = open_maps(maps) if is_read and maps.is_dir() else None
        self._class_counts = count_classes(frame.boxes for frame in self._boxes.frames)
        self._boxes_of = {frame.stamp.index: frame for frame in self._boxes.frames}

    @property
    def class_counts(self) -> Mapping[str, int]:
        return self._class_counts

    @property
    def input_files(self) -> tuple[Path, ...]:
        # Tables and videos, but no images, which are in folders.
        return tuple(sorted(path for path in self.path.iterdir() if path.is_file()))

    def _frame(self, place: int, entry: FrameEntry) -> Frame:
        index, time = entry.stamp.index, entry.stamp.timestamp_ns
        boxes = self._true_boxes(index, self.ego_motion.pose_at(time) if self.ego_motion else None)
        bev_map = self._maps.load(index) if self._maps and self._maps.has(index) else None
        frame = read_frame(entry, self.rig, self._images, self.ego_motion, boxes, bev_map)
        if not self.has_ego_motion:
            return frame
        results = (result for of_frame in self._true_results if (result := of_frame(frame)) is not None)
        return replace(frame, ground_truth_results=tuple(results))

    def _true_boxes(self, index: int, world_from_ego: Pose | None) -> Boxes3D | None:
        """A frame's boxes in the world frame, or without pose in the ego frame; None if the file lacks the frame.

        Boxes in the bev frame of a file that does not state its pose are in the bev frame of the rig.
        """
        truth, reference = self._boxes_of.get(index), self._boxes.frame_of_reference
        if truth is None:
            return None
        if reference == "world" and world_from_ego:
            return truth.boxes
        if reference == "bev" and self._boxes.ego_from_bev is None:
            boxes = truth.boxes.transformed(self.rig.ego_from_bev)
        else:
            boxes = self._boxes.in_ego(truth)
        return boxes.transformed(world_from_ego.matrix) if world_from_ego else boxes


def _read_entries(path: Path, rig: CameraRig) -> tuple[tuple[FrameEntry, ...], tuple[str, ...]]:
    """The frames of frames.csv, or else those that are found, with a note."""
    table = path / "frames.csv"
    if is_there(table):
        return read_frames_table(table, rig.names), ()
    entries, note = find_frames(path, rig.names)
    check_times(entries)
    return entries, (note,)


def _check_paths(folder: Path, entries: tuple[FrameEntry, ...]) -> None:
    """Raise InputError for a path that leads out of the folder. Links are followed when the image is read."""
    for entry in entries:
        for camera, source in entry.sources.items():
            path = source.path if isinstance(source, ImageSource) else folder
            if leads_out(path, folder):
                raise InputError(
                    f"{entry.origin}: camera {camera}: {path}: leads out of the folder: pass "
                    "`allow_outside=True` to read it"
                )


def _read_motion(file: Path, use: EgoMotionUse) -> tuple[EgoMotion | None, tuple[str, ...]]:
    if use == "static":
        unread = f" ({file.name} is not read)" if is_there(file) else ""
        return None, (f"the vehicle is assumed to stand still{unread}",)
    if is_there(file):
        return read_ego_motion(file), ()
    if use == "required":
        raise InputError(
            f"{file}: the file is missing (expected the vehicle's poses): add it, "
            'pass `ego_motion="static"` if the vehicle stands, or pass `temporal=False` to run without history'
        )
    return None, ("ego_motion.csv is missing: boxes are in the ego frame",)


def _check_coverage(file: Path, motion: EgoMotion, entries: tuple[FrameEntry, ...], advice: str) -> None:
    """Raise InputError for a frame or an image at whose time the pose is not known."""
    first, last = motion.first_ns, motion.last_ns
    for entry in entries:
        times = {"the frame": entry.stamp.timestamp_ns}
        times |= {f"camera {name}": source.timestamp_ns for name, source in entry.sources.items()}
        for what, time in times.items():
            if not first - TOLERANCE_NS <= time <= last + TOLERANCE_NS:
                raise InputError(
                    f"{file}: covers {first} to {last} ns, but {what} is at {time} ns ({entry.origin}; at most 50 ms "
                    f"outside is allowed): {advice}"
                )


def rig_notes(rig: CameraRig, source: str = "calibration.json") -> tuple[str, ...]:
    """Tells the user that the bev frame is the default, if it is. source: what does not state it."""
    if not rig.ego_from_bev_assumed:
        return ()
    return (f'{source} has no "ego_from_bev": the default is used, a level frame at (0.94, 0, 1.84) m in ego',)
