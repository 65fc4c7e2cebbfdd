"""The boxes of a recording, and their export: a table (.csv), or a boxes file that `bevcli eval` reads (.json)."""

from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.evaluation.formats.csv_table import write_csv
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Pose
from bevcli.recording import entities
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes, write_boxes
from bevcli.viewer.recording_reader import RecordedFrame, RecordingReader


def read_recording(recording: Path) -> BoxesFile:
    """The shown boxes of all frames, in the world frame."""
    return BoxesFile("world", tuple(recorded_boxes(frame) for frame in RecordingReader(recording).frames()))


def export_boxes(recording: Path, path: Path) -> tuple[int, int]:
    """Write the shown boxes, in the world frame, metres and radians; return the number of frames and of boxes.

    Raises InputError if the path does not end in .csv or .json, OutputError if the file cannot be written.
    """
    writers = {".csv": write_csv, ".json": write_boxes}
    if path.suffix.lower() not in writers:
        raise InputError(f"{path}: the file must end in .csv or .json")
    boxes = read_recording(recording)
    return len(boxes.frames), writers[path.suffix.lower()](boxes, path)


def recorded_boxes(frame: RecordedFrame) -> FrameBoxes:
    """The shown boxes of a frame in the sequence's world frame, highest score first; recordings store float32."""
    entity, origin = entities.BOXES, frame.array(entities.WORLD, "origin", 3).reshape(-1)[:3]
    origin = origin if len(origin) == 3 else np.zeros(3)
    quaternions = frame.array(entity, "Boxes3D:quaternions", 4)  # x, y, z, w
    boxes = Boxes3D(
        centers=frame.array(entity, "Boxes3D:centers", 3) + origin,
        sizes_lwh=2 * frame.array(entity, "Boxes3D:half_sizes", 3),
        yaws=2 * np.arctan2(quaternions[:, 2], quaternions[:, 3]),
        velocities=np.column_stack([frame.array(entity, f"velocity_{axis}", 1)[:, 0] for axis in "xy"]),
        classes=np.array(frame.values(entity, "name"), dtype=np.str_),
        scores=frame.array(entity, "score", 1)[:, 0],
        instances=np.array(frame.values(entity, "track"), dtype=np.str_) if frame.has(entity, "track") else None,
    )
    scene, time = (frame.values(entities.EGO, name) for name in ("scene", "timestamp_ns"))
    stamp = FrameStamp(frame.index, scene[0] if scene else "", int(time[0]) if time else 0)
    pose = frame.array(entities.EGO, "pose", 16)
    world_from_ego = pose[0].reshape(4, 4).copy() if len(pose) else np.eye(4)
    world_from_ego[:3, 3] += origin
    return FrameBoxes(stamp, Pose.from_matrix(world_from_ego), boxes)
