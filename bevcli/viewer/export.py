"""Exports the boxes of a recording: as a table (.csv), or as a boxes file that `bevcli eval` reads (.json)."""

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Pose
from bevcli.parsing.csv_cells import cell_of
from bevcli.recording import entities
from bevcli.sequences.files.boxes_file import BoxesWriter, FrameBoxes
from bevcli.viewer.recording_reader import RecordedFrame, RecordingReader
from bevcli.writing import whole_file

COLUMNS = (
    "frame", "scene", "timestamp_ns", "class", "score", "x", "y", "z", "length", "width", "height", "yaw",
    "velocity_x", "velocity_y", "instance",
)  # fmt: skip


def export_boxes(recording: Path, path: Path) -> tuple[int, int]:
    """Writes the shown boxes, in the world frame, metres and radians; returns the number of frames and of boxes.

    Raises InputError if the path does not end in .csv or .json, OutputError if the file cannot be written.
    """
    writers = {".csv": _write_csv, ".json": _write_json}
    if path.suffix.lower() not in writers:
        raise InputError(f"{path}: the file must end in .csv or .json")
    frames = [recorded_boxes(frame) for frame in RecordingReader(recording).frames()]
    writers[path.suffix.lower()](path, frames)
    return len(frames), sum(len(frame.boxes) for frame in frames)


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


def _write_csv(path: Path, frames: list[FrameBoxes]) -> None:
    with whole_file(path) as unfinished, unfinished.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for frame in frames:
            writer.writerows(_rows(frame))


def _rows(frame: FrameBoxes) -> Iterator[list[object]]:
    stamp, boxes = frame.stamp, frame.boxes
    assert boxes.scores is not None
    for i, score in enumerate(boxes.scores):
        numbers = (score, *boxes.centers[i], *boxes.sizes_lwh[i], boxes.yaws[i], *boxes.velocities[i])
        instance = "" if boxes.instances is None else cell_of(boxes.instances[i])
        rounded = (f"{number:.4f}" for number in numbers)
        yield [stamp.index, cell_of(stamp.scene), stamp.timestamp_ns, cell_of(boxes.classes[i]), *rounded, instance]


def _write_json(path: Path, frames: list[FrameBoxes]) -> None:
    with BoxesWriter(path, "world") as writer:
        for frame in frames:
            writer.write(frame)
