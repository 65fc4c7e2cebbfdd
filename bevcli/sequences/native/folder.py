"""The native sequence folder as a Sequence. Without frames.csv, its frames are found by image names or videos.

timing.toml states their times:
start_ns = 1533151603547590000   # time of the first image; default 0
rate_hz = 12.0                   # images per second; default for a video: the rate in its file
[cameras.CAM_BACK]               # where one camera differs
offset_ns = 25000000             # its first image is this much later than start_ns
rate_hz = 24.0
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from bevcli.errors import InputError
from bevcli.frame import DriveFacts, Frame, FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import TOLERANCE_NS, EgoMotion
from bevcli.geometry.transforms import Pose
from bevcli.parsing.documents import TOML_BYTES, parse_toml, read_csv
from bevcli.parsing.files import is_there, read_text
from bevcli.printing import counted
from bevcli.sequences.files.boxes_file import BoxesFile, count_classes, read_boxes
from bevcli.sequences.files.calibration_file import CALIBRATION, read_rig_and_facts
from bevcli.sequences.files.ego_motion_file import read_ego_motion
from bevcli.sequences.files.incremental_json import existing
from bevcli.sequences.files.map_folder import open_maps
from bevcli.sequences.format import true_results
from bevcli.sequences.images import (
    IMAGE_SUFFIXES,
    VIDEO_SUFFIXES,
    FrameEntry,
    ImageSource,
    ListedSequence,
    bev_frame_notes,
    count_and_rate,
    leads_out,
    rotation_notes,
)
from bevcli.sequences.options import EgoMotionUse, RigOptions, SequenceOptions

BOXES_FILE = "ground_truth.json"
MAPS_FOLDER = "ground_truth_map"
FILE_NAME = "timing.toml"
VIDEO_CELL = re.compile(r"(?P<path>.+)#(?P<index>[0-9]{1,9})")
NO_IMAGE = "no image in frames.csv"
# A number in an image's name is a time in nanoseconds from this value on (hours after 1970), an index below it.
SMALLEST_TIMESTAMP = 10**13
ASSUMED_RATE_HZ = 2.0  # rate of numbered images without timing.toml: the rate of the published models


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
        rig, facts = own.rig() if rig is None else rig, DriveFacts()
        if rig is None:
            rig, facts = read_rig_and_facts(path / CALIBRATION)
        table = path / "frames.csv"
        notes: tuple[str, ...] = ()
        if is_there(table):
            entries = read_frames_table(table, rig.names)
        else:
            entries, notes = find_frames(path, rig.names)
        if not common.allow_outside:
            _check_paths(path, entries)
        file = own.ego_motion_file or path / "ego_motion.csv"
        advice = "set start_ns in timing.toml" if notes else "add ego-motion, or remove the frame"
        motion, motion_notes = _read_motion(file, common.ego_motion, entries, advice)
        boxes, maps, has_truth = path / BOXES_FILE, path / MAPS_FOLDER, common.ground_truth  # each file may be missing
        self._boxes = read_boxes(boxes) if has_truth and is_there(existing(boxes)) else BoxesFile("ego", ())
        self._boxes_of = {frame.stamp.index: frame for frame in self._boxes.frames}
        self._true_results = true_results("native", path) if has_truth else ()
        self._maps = open_maps(maps) if has_truth and maps.is_dir() else None  # which are read frame by frame
        sources = [source for entry in entries for source in entry.sources.values() if isinstance(source, ImageSource)]
        videos = sorted({source.path for source in sources if source.video_index is not None})
        notes = (*bev_frame_notes(rig), *notes, *motion_notes, *(rotation_notes(videos) if videos else ()))
        super().__init__(path, common, rig, entries, motion, notes=notes)
        self.facts = facts

    @property
    def class_counts(self) -> Mapping[str, int]:
        return count_classes(frame.boxes for frame in self._boxes.frames)

    @property
    def input_files(self) -> tuple[Path, ...]:
        # Tables and videos, but no images, which are in folders.
        return tuple(sorted(path for path in self.path.iterdir() if path.is_file()))

    def _frame(self, place: int, entry: FrameEntry) -> Frame:
        index, time = entry.stamp.index, entry.stamp.timestamp_ns
        boxes = self._true_boxes(index, self.ego_motion.pose_at(time) if self.ego_motion else None)
        bev_map = self._maps.load(index) if self._maps and self._maps.has(index) else None
        frame = replace(super()._frame(place, entry), ground_truth=boxes, ground_truth_map=bev_map)
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


def _read_motion(
    file: Path, use: EgoMotionUse, entries: tuple[FrameEntry, ...], advice: str
) -> tuple[EgoMotion | None, tuple[str, ...]]:
    """The poses, None without any, and notes. advice: for frames at times that the poses do not cover."""
    if use == "static":
        unread = f" ({file.name} is not read)" if is_there(file) else ""
        return None, (f"the vehicle is assumed to stand still{unread}",)
    if not is_there(file) and use == "required":
        raise InputError(
            f"{file}: the file is missing (expected the vehicle's poses): add it, "
            'pass `ego_motion="static"` if the vehicle stands, or pass `temporal=False` to run without history'
        )
    if not is_there(file):
        return None, ("ego_motion.csv is missing: boxes are in the ego frame",)
    motion = read_ego_motion(file)
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
    return motion, ()


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


Found = tuple[tuple[FrameEntry, ...], tuple[str, ...]]  # frames, and a note


@dataclass(frozen=True)
class Timing:
    """Timing of numbered images or of a video. start_ns: of the first image. rate_hz: None if not stated."""

    start_ns: int
    rate_hz: float | None


@dataclass(frozen=True)
class CameraVideo:
    """The video of a camera: number of images, time of the first, images per second."""

    path: Path
    count: int
    start_ns: int
    rate_hz: float

    def image(self, number: int) -> ImageSource:
        """An image by its number, from 0."""
        return ImageSource(self.path, self.start_ns + round(number * 1e9 / self.rate_hz), number)

    def nearest(self, time: int) -> ImageSource | None:
        """The image nearest to a time in ns, None if it is more than half a period away."""
        number = round((time - self.start_ns) * self.rate_hz / 1e9)
        image = self.image(min(max(number, 0), self.count - 1))
        return image if abs(image.timestamp_ns - time) <= 0.501e9 / self.rate_hz else None


def read_timing(folder: Path, cameras: tuple[str, ...]) -> tuple[Timing, dict[str, Timing]]:
    """The common timing in timing.toml, and that of each camera; the defaults if the file is missing.

    Raises InputError for broken TOML, an unknown key or camera, or an invalid value.
    """
    path = folder / FILE_NAME
    stated = parse_toml(read_text(path, TOML_BYTES), path) if is_there(path) else {}
    _check_keys(path, "", stated, ("start_ns", "rate_hz", "cameras"))
    own = stated.get("cameras", {})
    if not isinstance(own, dict):
        raise InputError(f'{path}: "cameras": expected a table for each camera, such as [cameras.{cameras[0]}]')
    _check_keys(path, "cameras.", own, cameras)
    common = Timing(_integer(path, "", stated, "start_ns"), _rate(path, "", stated))
    return common, {name: _camera(path, f"cameras.{name}", own.get(name, {}), common) for name in cameras}


def _camera(path: Path, where: str, table: Any, common: Timing) -> Timing:
    if not isinstance(table, dict):
        raise InputError(f"{path}: {where}: expected a table, such as [{where}]")
    _check_keys(path, f"{where}.", table, ("offset_ns", "rate_hz"))
    offset_ns = _integer(path, f"{where}.", table, "offset_ns")
    return Timing(common.start_ns + offset_ns, _rate(path, f"{where}.", table) or common.rate_hz)


def _check_keys(path: Path, where: str, table: Mapping[str, Any], known: tuple[str, ...]) -> None:
    for key in table:
        if key not in known:
            raise InputError(f'{path}: unknown key "{where}{key}" (known: {", ".join(known)})')


def _integer(path: Path, where: str, table: Mapping[str, Any], key: str) -> int:
    value = table.get(key, 0)
    if not isinstance(value, int) or isinstance(value, bool):
        raise InputError(f"{path}: {where}{key}: expected an integer (nanoseconds), found {value!r}")
    return value


def _rate(path: Path, where: str, table: Mapping[str, Any]) -> float | None:
    value = table.get("rate_hz")
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < 10_000:
        raise InputError(f"{path}: {where}rate_hz: expected images per second, above 0, found {value!r}")
    return float(value)


def find_frames(folder: Path, cameras: tuple[str, ...]) -> Found:
    """The frames in `images/CAMERA/*` or `videos/CAMERA.*`, and a note that tells the user how they were found.

    Raises InputError if there is neither, or if the cameras' images do not have the same names.
    """
    common, timings = read_timing(folder, cameras)
    if (folder / "images").is_dir():
        return _from_names(folder, common, timings)
    if (folder / "videos").is_dir():
        return _from_videos(folder, timings)
    raise InputError(
        f"{folder}: frames.csv, images/ and videos/ are missing: add a frames.csv, "
        "images/CAMERA/TIMESTAMP.jpg, or videos/CAMERA.mp4"
    )


def _from_names(folder: Path, common: Timing, timings: Mapping[str, Timing]) -> Found:
    images = {name: _numbered(folder / "images" / name) for name in timings}
    numbers = _common_numbers(folder, images)
    are_times = numbers[0] >= SMALLEST_TIMESTAMP
    rate = common.rate_hz or ASSUMED_RATE_HZ
    entries = []
    for place, number in enumerate(numbers):
        time = number if are_times else common.start_ns + round((number - numbers[0]) * 1e9 / rate)
        sources = {
            name: ImageSource(found[number], time + timings[name].start_ns - common.start_ns)
            for name, found in images.items()
        }
        stamp = FrameStamp(place if are_times else number, "", time)
        entries.append(FrameEntry(stamp, sources, {}, f"{folder / 'images'}: image {number}"))
    how = "timestamps from the image names" if are_times else f"numbered images at {rate:g} per second"
    where = "" if are_times or common.rate_hz else f" (assumed; set rate_hz in {FILE_NAME})"
    return tuple(entries), (f"frames.csv is missing: found {counted(len(numbers), 'frames')}, {how}{where}",)


def _numbered(folder: Path) -> dict[int, Path]:
    if not folder.is_dir():
        raise InputError(f"{folder}: the folder is missing (the calibration has the camera {folder.name})")
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in IMAGE_SUFFIXES:
            continue
        if not (path.stem.isascii() and path.stem.isdigit()):
            raise InputError(f"{path}: the name is not a number (expected a time or an index): list it in frames.csv")
        if int(path.stem) in found:
            raise InputError(f"{path}: {found[int(path.stem)].name} has the same number: remove one")
        found[int(path.stem)] = path
    if not found:
        raise InputError(f"{folder}: the folder has no images (expected files ending in {', '.join(IMAGE_SUFFIXES)})")
    return found


def _common_numbers(folder: Path, images: Mapping[str, Mapping[int, Path]]) -> list[int]:
    """The sorted image numbers, which must be the same for every camera."""
    everywhere = sorted(set().union(*images.values()))
    for name, found in images.items():
        missing = [number for number in everywhere if number not in found]
        if missing:
            raise InputError(
                f"{folder / 'images' / name}: {len(missing)} images are missing that other cameras have, the first "
                f"is {missing[0]}: add them, or list the frames in frames.csv and leave cells empty"
            )
    return everywhere


def _from_videos(folder: Path, timings: Mapping[str, Timing]) -> Found:
    """One frame for each image of the camera with the lowest rate, with the other cameras' nearest images."""
    videos = {name: _video_of(folder / "videos", name, timing) for name, timing in timings.items()}
    name, leading = min(videos.items(), key=lambda item: item[1].rate_hz)  # the first of cameras with equal rates
    entries = []
    for place in range(leading.count):
        time = leading.image(place).timestamp_ns
        nearest = {camera: video.nearest(time) for camera, video in videos.items()}
        sources = {camera: source for camera, source in nearest.items() if source is not None}
        dropped = {
            camera: f"{video.path.name} has no image within {500 / video.rate_hz:.0f} ms of {time} ns"
            for camera, video in videos.items()
            if nearest[camera] is None
        }
        entries.append(FrameEntry(FrameStamp(place, "", time), sources, dropped, f"{leading.path}#{place}"))
    has_timing = is_there(folder / FILE_NAME)
    stated = f"times from {FILE_NAME}" if has_timing else f"starting at time 0 (set start_ns in {FILE_NAME})"
    note = f"frames.csv is missing: found {counted(len(entries), 'frames')} from {name}, {leading.rate_hz:g} per second"
    return tuple(entries), (f"{note}, {stated}",)


def _video_of(folder: Path, camera: str, timing: Timing) -> CameraVideo:
    found = [path for path in sorted(folder.glob(f"{camera}.*")) if path.suffix.lower() in VIDEO_SUFFIXES]
    if len(found) != 1:
        names = ", ".join(path.name for path in found) or "none"
        raise InputError(f"{folder}: camera {camera}: expected one video, such as {camera}.mp4, found {names}")
    count, rate_hz = count_and_rate(found[0])
    return CameraVideo(found[0], count, timing.start_ns, timing.rate_hz or rate_hz)
