"""The native sequence folder as a drive."""

import re
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import Frame, FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Pose
from bevcli.options import named
from bevcli.parsing.documents import read_csv
from bevcli.parsing.files import is_there
from bevcli.sequences.files.boxes_file import BoxesFile, count_classes, read_boxes
from bevcli.sequences.files.calibration_file import CALIBRATION, RigDraft, draft_of, draft_rig
from bevcli.sequences.files.ego_motion_file import DrivePoses, FrameTimesNeeded, ReadPoses, read_poses
from bevcli.sequences.files.incremental_json import existing
from bevcli.sequences.files.map_folder import open_maps
from bevcli.sequences.format import TrueResult
from bevcli.sequences.images import FrameEntry, ImageSource, ListedDrive, bev_frame_notes, leads_out, rotation_notes
from bevcli.sequences.native import FolderOptions
from bevcli.sequences.options import EgoMotionUse, InputOptions, RigOptions

BOXES_FILE = "ground_truth.json"
MAPS_FOLDER = "ground_truth_map"
LINES_FILE = "ground_truth_lines.json"
VIDEO_CELL = re.compile(r"(?P<path>.+)#(?P<index>[0-9]{1,9})")
EGO_MOTION_FILE = named(FolderOptions, "ego_motion_file")
NO_IMAGE = "no image in frames.csv"
IMAGE_TIMES = ("times", "image_rate_hz", "start_ns")  # options of folders without frames.csv


class FolderDrive(ListedDrive):
    """A native sequence folder as a `Drive`, or a video of one camera.

    draft: used in place of the rig of `own` and of calibration.json, if given.
    Attribute understood: how the images were understood without frames.csv, "" with it.
    Attribute draft: the rig, as the images show it.
    Raises InputError if a file of the folder is missing or invalid.
    """

    def __init__(
        self,
        path: Path,
        common: InputOptions = InputOptions(),
        own: FolderOptions = FolderOptions(),
        draft: RigDraft | None = None,
    ) -> None:
        if not path.exists():
            raise InputError(f"{path}: the sequence folder is missing")
        if draft is None:
            draft = draft_of(own, path) or draft_rig(path / CALIBRATION, path).checked(path / CALIBRATION)
        rig, facts = draft.rig, draft.facts
        table, file = path / "frames.csv", own.ego_motion_file or path / "ego_motion.csv"
        entries = read_frames_table(table, rig.names) if is_there(table) else ()
        for name in IMAGE_TIMES if entries else ():
            if getattr(own, name) is not None:
                without = f"{named(FolderOptions, name)} would have no effect"
                raise InputError(f"{table}: states the times of all images, and {without}: remove the option")
        is_open = bool(draft.readings)
        poses = _poses_without_frames(file, common.ego_motion, _drive_poses(rig, own, entries, is_open))
        self.understood, left_out, advice = "", "", "add ego-motion, or remove the frame"
        if not entries:
            from bevcli.workshop.formats import matching, unlisted

            if not (path / "videos").is_dir():
                used, left_out = matching.cameras_with_images(rig.names, path)
                rig = replace(rig, cameras=tuple(camera for camera in rig.cameras if camera.name in used))
            motion, has_poses = (None, True) if poses is None else (poses.motion, poses.motion is not None)
            frames = unlisted.find_frames(path, rig.names, own, motion, has_poses=has_poses)
            poses = poses or _read_poses(file, common.ego_motion, _drive_poses(rig, own, frames[0], is_open))
            entries, self.understood = frames if poses.motion is None else matching.covered(frames, poses.motion)
            advice = "state the time of the first image by `start_ns` (`--start-ns`), or in timing.toml"
        assert poses is not None
        if not common.allow_outside:
            _check_paths(path, entries)
        check_covered(file, poses, entries, advice)
        draft, poses = decided(replace(draft, rig=rig), poses, ListedDrive(path, common, rig, entries, None), own)
        rig, self.draft = draft.rig, draft
        boxes, maps, has_truth = path / BOXES_FILE, path / MAPS_FOLDER, common.ground_truth  # each file may be missing
        self._boxes = read_boxes(boxes) if has_truth and is_there(existing(boxes)) else BoxesFile("ego", ())
        self._boxes_of = {frame.stamp.index: frame for frame in self._boxes.frames}
        self._true_lines = _true_lines(path) if has_truth else None
        self._maps = open_maps(maps) if has_truth and maps.is_dir() else None  # which are read frame by frame
        sources = [source for entry in entries for source in entry.sources.values() if isinstance(source, ImageSource)]
        videos = sorted({source.path for source in sources if source.video_index is not None})
        assumed = ("the calibration",) if draft.notes else ()
        notes = (
            *draft.notes,
            *bev_frame_notes(rig, *assumed),
            *filter(None, [self.understood, left_out]),
            *poses.notes,
        )
        notes += tuple(rotation_notes(videos))
        super().__init__(path, common, rig, entries, poses.motion, notes=notes)
        self.facts = replace(facts, geo_origin=facts.geo_origin or poses.geo_origin)

    @property
    def class_counts(self) -> Mapping[str, int]:
        return count_classes(frame.boxes for frame in self._boxes.frames)

    @property
    def input_files(self) -> tuple[Path, ...]:
        # Tables and videos, but no images, which are in folders.
        paths = [self.path] if self.path.is_file() else self.path.iterdir()
        return tuple(sorted(path for path in paths if path.is_file()))

    def _frame(self, position: int, entry: FrameEntry) -> Frame:
        index, time = entry.stamp.index, entry.stamp.timestamp_ns
        boxes = self._true_boxes(index, self.ego_motion.pose_at(time) if self.ego_motion else None)
        bev_map = self._maps.load(index) if self._maps and self._maps.has(index) else None
        frame = replace(super()._frame(position, entry), ground_truth=boxes, ground_truth_map=bev_map)
        lines = self._true_lines(frame) if self._true_lines and self.has_ego_motion else None
        return frame if lines is None else replace(frame, ground_truth_results=(lines,))

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


def _true_lines(folder: Path) -> TrueResult | None:
    """The reader of the lines of the map; None without their file. Raises InputError."""
    if not is_there(existing(folder / LINES_FILE)):
        return None
    from bevcli.workshop.formats.map_lines import TrueLines

    return TrueLines(folder / LINES_FILE)


def _check_paths(folder: Path, entries: tuple[FrameEntry, ...]) -> None:
    """Raise InputError for a path that leads out of the folder. Links are followed when the image is read."""
    for entry in entries:
        for camera, source in entry.sources.items():
            path = source.path if isinstance(source, ImageSource) else folder
            if leads_out(path, folder):
                raise InputError(
                    f"{entry.origin}: camera {camera}: {path}: leads out of the folder: pass "
                    "`allow_outside=True` (`--allow-outside`) to read it"
                )


def _poses_without_frames(file: Path, use: EgoMotionUse, drive: DrivePoses) -> ReadPoses | None:
    """The poses; None where the times of the frames, which are not known yet, decide how they are read."""
    try:
        return _read_poses(file, use, drive)
    except FrameTimesNeeded:
        return None


def _read_poses(file: Path, use: EgoMotionUse, drive: DrivePoses) -> ReadPoses:
    """The poses, with notes. Raises FrameTimesNeeded as `read_poses`."""
    if use == "static":
        unread = f" ({file.name} is not read)" if is_there(file) else ""
        return ReadPoses(None, (f"the vehicle is assumed to stand still{unread}",))
    if not is_there(file) and drive.stated.ego_motion_file is not None:
        raise InputError(f"{file}: the file is missing (expected the vehicle's poses, of {EGO_MOTION_FILE})")
    if not is_there(file) and use == "required":
        raise InputError(
            f"{file}: the file is missing (expected the vehicle's poses): add it, "
            'pass `odometry=True` (`--odometry`) to measure them from the images, `ego_motion="static"` (`--static`) '
            "if the vehicle stands, or `temporal=False` (`--no-temporal`) to run without history"
        )
    if not is_there(file):
        return ReadPoses(None, () if use == "measured" else ("ego_motion.csv is missing: boxes are in the ego frame",))
    return read_poses(file, drive)


def _drive_poses(rig: CameraRig, own: RigOptions, entries: tuple[FrameEntry, ...], is_open: bool) -> DrivePoses:
    """What poses are for; without times as long as there are no frames."""
    times, numbers = (
        np.array([(each.stamp.timestamp_ns, each.stamp.index) for each in entries], np.int64).reshape(-1, 2).T
    )
    return DrivePoses(rig, own, times, is_open, numbers) if entries else DrivePoses(rig, own, None, is_open)


def check_covered(file: Path, poses: ReadPoses, entries: tuple[FrameEntry, ...], advice: str) -> None:
    """Raise InputError for a frame or an image at a time that the poses do not cover. advice: what to do."""
    if poses.motion is None:
        return
    first, last = poses.motion.first_ns, poses.motion.last_ns
    read_as = f", read as {poses.notes[0]}" if poses.notes else ""
    for entry in entries:
        times = {"the frame": entry.stamp.timestamp_ns}
        times |= {f"camera {name}": source.timestamp_ns for name, source in entry.sources.items()}
        for what, time in times.items():
            if not poses.motion.covered(time):
                raise InputError(
                    f"{file}: covers {first} to {last} ns, but {what} is at {time} ns ({entry.origin}; at most 50 ms "
                    f"outside is allowed{read_as}): {advice}"
                )


def decided(draft: RigDraft, poses: ReadPoses, images: ListedDrive, options: RigOptions) -> tuple[RigDraft, ReadPoses]:
    """The rig and the poses of a drive without other readings, as its images show them.

    images: the drive, with any of the rigs. Raises InputError where the images do not decide: it names the options
    that do.
    """
    if not draft.readings and not poses.readings:
        return draft, poses
    from bevcli.workshop.readings.judge import decide

    return decide(draft, poses, images, options)


def read_frames_table(path: Path, cameras: tuple[str, ...]) -> tuple[FrameEntry, ...]:
    """Read frames.csv. A camera's cell is a path relative to the table's folder, or `video#index`.

    Raises InputError for an invalid column or cell, a camera without a column, or times that do not increase in a
    scene.
    """
    times = [f"{name}.timestamp_ns" for name in cameras]
    rows = read_csv(path, ("frame", "timestamp_ns"), ("scene", *cameras, *times))
    for name in cameras:
        if name not in rows[0].cells:
            raise InputError(
                f"{path}: camera {name}: its column is missing (expected, because the calibration has the camera): "
                f'add a column "{name}" (cells may be empty), or remove the camera from the calibration'
            )
    lines: dict[int, int] = {}  # of frames, by index
    entries = []
    for row in rows:
        stamp = FrameStamp(row.integer("frame"), row.cells.get("scene", ""), row.integer("timestamp_ns"))
        if stamp.index < 0 or stamp.index in lines:
            found = f"is also on line {lines[stamp.index]}" if stamp.index in lines else "is negative"
            raise row.error("frame", f"{stamp.index} {found} (expected a unique integer, 0 or more)")
        lines[stamp.index] = row.line
        sources: dict[str, ImageSource] = {}
        for name in (name for name in cameras if row.cells[name]):
            column = f"{name}.timestamp_ns"
            timestamp_ns = row.integer(column) if row.cells.get(column) else stamp.timestamp_ns
            video = VIDEO_CELL.fullmatch(row.cells[name])
            file, index = (video["path"], int(video["index"])) if video else (row.cells[name], None)
            sources[name] = ImageSource(path.parent / file, timestamp_ns, index)
        dropped = {name: NO_IMAGE for name in cameras if not row.cells[name]}
        entries.append(FrameEntry(stamp, sources, dropped, f"{path}: line {row.line}"))
    for earlier, entry in pairwise(entries):
        before, stamp = earlier.stamp, entry.stamp
        if before.scene == stamp.scene and stamp.timestamp_ns <= before.timestamp_ns:
            raise InputError(
                f"{entry.origin}: timestamp_ns {stamp.timestamp_ns} is not later than the previous frame's "
                f"({before.timestamp_ns}): sort the frames by time, or give them different scenes"
            )
    return tuple(entries)
