"""The native sequence folder as a Sequence."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from bevcli.errors import InputError
from bevcli.frame import DriveFacts, Frame, FrameStamp
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import TOLERANCE_NS, EgoMotion
from bevcli.sequences.files.calibration_file import read_rig_and_facts
from bevcli.sequences.frame_reading import read_frame
from bevcli.sequences.images import ImageReader, ImageSource
from bevcli.sequences.native.ego_motion_file import read_ego_motion
from bevcli.sequences.native.frames_table import FrameEntry, check_times, read_frames_table
from bevcli.sequences.native.ground_truth import FolderGroundTruth, GroundTruthUse
from bevcli.sequences.native.unlisted_frames import find_frames

# required: ego_motion.csv must exist. optional: without the file there are no poses.
# static: the vehicle stands, and the file is not read.
EgoMotionUse = Literal["required", "optional", "static"]
# Any of these makes a folder a native sequence, so that an incomplete one gets an error that names the missing file.
MARKERS = ("calibration.json", "frames.csv", "ego_motion.csv", "images", "videos")


def is_native_folder(path: Path) -> bool:
    """Whether a folder contains any part of a native sequence."""
    return any((path / part).exists() for part in MARKERS)


class FolderSequence:
    """A native sequence folder as a `Sequence`.

    rig: used in place of calibration.json, if given. ego_motion_file: used in place of ego_motion.csv, if given.
    ground_truth: see `GroundTruthUse`. allow_outside: whether images may lie outside of the folder.
    Raises InputError if a file of the folder is missing or invalid.
    """

    def __init__(
        self,
        path: Path,
        *,
        ego_motion: EgoMotionUse = "required",
        strict: bool = False,
        rig: CameraRig | None = None,
        ego_motion_file: Path | None = None,
        ground_truth: GroundTruthUse = GroundTruthUse(),
        allow_outside: bool = False,
    ) -> None:
        if not path.is_dir():
            raise InputError(f"{path}: the sequence folder is missing")
        self.path = path
        self.name = path.resolve().name
        calibration = path / "calibration.json"
        self.rig, self.facts = read_rig_and_facts(calibration) if rig is None else (rig, DriveFacts())
        self._entries, notes = _read_entries(path, self.rig)
        if not allow_outside:
            _check_paths(path, self._entries)
        self.ego_motion, motion_notes = _read_motion(
            ego_motion_file or path / "ego_motion.csv", ego_motion, self._entries
        )
        self.has_ego_motion = self.ego_motion is not None
        self._truth = FolderGroundTruth(path, ground_truth)
        self.notes = (*rig_notes(self.rig), *notes, *motion_notes, *self._truth.notes)
        self._images = ImageReader(strict=strict, inside=None if allow_outside else path)

    @property
    def stamps(self) -> tuple[FrameStamp, ...]:
        """Index, scene and time of each frame, in order."""
        return tuple(entry.stamp for entry in self._entries)

    @property
    def input_files(self) -> tuple[Path, ...]:
        """Tables and videos: the files in the folder itself. A run can be resumed only if they are the same."""
        return tuple(sorted(path for path in self.path.iterdir() if path.is_file()))

    def load(self, place: int) -> Frame:
        """The frame at position `place`, with decoded images. Raises InputError as `ImageReader.read`."""
        entry = self._entries[place]
        stamp = entry.stamp
        pose = self.ego_motion.pose_at(stamp.timestamp_ns) if self.ego_motion else None
        boxes = self._truth.boxes(stamp.index, pose, self.rig.ego_from_bev)
        bev_map = self._truth.bev_map(stamp.index)
        return read_frame(entry, self.rig, self._images, self.ego_motion, boxes, bev_map)


def _read_entries(path: Path, rig: CameraRig) -> tuple[tuple[FrameEntry, ...], tuple[str, ...]]:
    table = path / "frames.csv"
    if table.is_file():
        return read_frames_table(table, rig.names), ()
    found = find_frames(path, rig.names)
    check_times(found.entries)
    return found.entries, (found.note,)


def _check_paths(folder: Path, entries: tuple[FrameEntry, ...]) -> None:
    """Raise InputError for an absolute path or one with "..". Links are followed when the image is read."""
    for entry in entries:
        for camera, source in entry.sources.items():
            path = source.path if isinstance(source, ImageSource) else folder
            if not path.is_relative_to(folder) or ".." in path.relative_to(folder).parts:
                raise InputError(
                    f"{entry.origin}: camera {camera}: {path}: leads out of the folder: pass --allow-outside to read it"
                )


def _read_motion(
    file: Path, use: EgoMotionUse, entries: tuple[FrameEntry, ...]
) -> tuple[EgoMotion | None, tuple[str, ...]]:
    if use == "static":
        unread = f" ({file.name} is not read)" if file.is_file() else ""
        return None, (f"the vehicle is assumed to stand still{unread}",)
    if file.is_file():
        motion = read_ego_motion(file)
        _check_coverage(file, motion, entries)
        return motion, ()
    if use == "required":
        raise InputError(
            f"{file}: the file is missing (expected the vehicle's poses): add it, pass --static if the vehicle stands, "
            "or pass --no-temporal to run without history"
        )
    return None, ("ego_motion.csv is missing: boxes are in the ego frame",)


def _check_coverage(file: Path, motion: EgoMotion, entries: tuple[FrameEntry, ...]) -> None:
    first, last = int(motion.timestamps_ns[0]), int(motion.timestamps_ns[-1])
    for entry in entries:
        times = {"the frame": entry.stamp.timestamp_ns}
        times |= {f"camera {name}": source.timestamp_ns for name, source in entry.sources.items()}
        for what, time in times.items():
            if not first - TOLERANCE_NS <= time <= last + TOLERANCE_NS:
                listed = entry.origin.startswith(str(file.with_name("frames.csv")))
                advice = "add ego-motion, or remove the frame" if listed else "set start_ns in timing.toml"
                raise InputError(
                    f"{file}: covers {first} to {last} ns, but {what} is at {time} ns ({entry.origin}; at most 50 ms "
                    f"outside is allowed): {advice}"
                )


def rig_notes(rig: CameraRig, source: str = "calibration.json") -> tuple[str, ...]:
    """Tells the user that the bev frame is the default, if it is. source: what does not state it."""
    if not rig.ego_from_bev_assumed:
        return ()
    return (f'{source} has no "ego_from_bev": the default is used, a level frame at (0.94, 0, 1.84) m in ego',)
