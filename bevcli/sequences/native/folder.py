"""The native sequence folder as a Sequence."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import Frame, FrameStamp
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import GRAVITY, TOLERANCE_NS, EgoMotion, Kinematics
from bevcli.geometry.transforms import Pose
from bevcli.sequences.files.calibration_file import read_calibration
from bevcli.sequences.images import ImageReader
from bevcli.sequences.native.ego_motion_file import read_ego_motion
from bevcli.sequences.native.frames_table import FrameEntry, check_times, read_frames_table
from bevcli.sequences.native.ground_truth import FolderGroundTruth
from bevcli.sequences.native.unlisted_frames import find_frames

# required: ego_motion.csv must exist. optional: without the file there are no poses.
# static: the vehicle stands, and the file is not read.
EgoMotionUse = Literal["required", "optional", "static"]
# Any of these makes a folder a native sequence, so that an incomplete one gets an error that names the missing file.
MARKERS = ("calibration.json", "frames.csv", "ego_motion.csv", "images", "videos")
AT_REST = Kinematics(np.array([0.0, 0.0, GRAVITY]), np.zeros(3), np.zeros(3))


def is_native_folder(path: Path) -> bool:
    """Whether a folder contains any part of a native sequence."""
    return any((path / part).exists() for part in MARKERS)


class FolderSequence:
    """A native sequence folder as a `Sequence`.

    rig: used in place of calibration.json, if given.
    Raises InputError if a file of the folder is missing or invalid.
    """

    def __init__(
        self,
        path: Path,
        *,
        ego_motion: EgoMotionUse = "required",
        strict: bool = False,
        rig: CameraRig | None = None,
    ) -> None:
        if not path.is_dir():
            raise InputError(f"{path}: the sequence folder is missing")
        self.path = path
        self.name = path.resolve().name
        self.rig = read_calibration(path / "calibration.json") if rig is None else rig
        self._entries, notes = _read_entries(path, self.rig)
        self.ego_motion, motion_notes = _read_motion(path, ego_motion, self._entries)
        self.has_ego_motion = self.ego_motion is not None
        self.notes = (*_rig_notes(self.rig), *notes, *motion_notes)
        self._truth = FolderGroundTruth(path)
        self._images = ImageReader(strict=strict)

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
        images, dropped = self._images.read(entry.sources, self.rig, entry.dropped)
        times = _camera_times(entry, self.rig)
        index, world_from_ego = entry.stamp.index, self._pose_at(entry.stamp.timestamp_ns)
        truth_pose = world_from_ego if self.has_ego_motion else None
        return Frame(
            stamp=entry.stamp,
            rig=self.rig,
            images=images,
            world_from_ego=world_from_ego,
            world_from_ego_at={name: self._pose_at(time) for name, time in times.items()},
            kinematics=self._kinematics_at(entry.stamp.timestamp_ns),
            dropped=dropped,
            ground_truth=self._truth.boxes(index, truth_pose, self.rig.ego_from_bev),
            ground_truth_map=self._truth.bev_map(index),
        )

    def _pose_at(self, timestamp_ns: int) -> Pose:
        return self.ego_motion.pose_at(timestamp_ns) if self.ego_motion else Pose.identity()

    def _kinematics_at(self, timestamp_ns: int) -> Kinematics:
        return self.ego_motion.kinematics_at(timestamp_ns) if self.ego_motion else AT_REST


def _read_entries(path: Path, rig: CameraRig) -> tuple[tuple[FrameEntry, ...], tuple[str, ...]]:
    table = path / "frames.csv"
    if table.is_file():
        return read_frames_table(table, rig.names), ()
    found = find_frames(path, rig.names)
    check_times(found.entries)
    return found.entries, (found.note,)


def _camera_times(entry: FrameEntry, rig: CameraRig) -> dict[str, int]:
    """Time of each camera's image, ns; the frame's time for a camera without an image."""
    frame_ns = entry.stamp.timestamp_ns
    return {name: entry.sources[name].timestamp_ns if name in entry.sources else frame_ns for name in rig.names}


def _read_motion(
    path: Path, use: EgoMotionUse, entries: tuple[FrameEntry, ...]
) -> tuple[EgoMotion | None, tuple[str, ...]]:
    file = path / "ego_motion.csv"
    if use == "static":
        unread = " (ego_motion.csv is not read)" if file.is_file() else ""
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


def _rig_notes(rig: CameraRig) -> tuple[str, ...]:
    if not rig.ego_from_bev_assumed:
        return ()
    return ('calibration.json has no "ego_from_bev": the default is used, a level frame at (0.94, 0, 1.84) m in ego',)
