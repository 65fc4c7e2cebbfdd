"""The boxes of a recording, as they were shown: in the drive's world again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Pose
from bevcli.recording import entities
from bevcli.viewer.recording_reader import RecordedFrame


@dataclass(frozen=True)
class RecordedBoxes:
    """One frame's shown boxes. boxes: in the world frame, best first. world_from_ego: at the frame's time."""

    stamp: FrameStamp
    world_from_ego: Pose
    boxes: Boxes3D


def recorded_boxes(frame: RecordedFrame) -> RecordedBoxes:
    """The boxes at a frame; the recording's own world is moved back to the drive's (float32 in between)."""
    entity = entities.BOXES
    origin = frame.array(entities.WORLD, "origin", 3).reshape(-1)[:3]
    origin = origin if len(origin) == 3 else np.zeros(3)
    turns = frame.array(entity, "Boxes3D:quaternions", 4)
    boxes = Boxes3D(
        centers=frame.array(entity, "Boxes3D:centers", 3) + origin,
        sizes_lwh=2 * frame.array(entity, "Boxes3D:half_sizes", 3),
        yaws=2 * np.arctan2(turns[:, 2], turns[:, 3]),
        velocities=np.column_stack([frame.array(entity, f"velocity_{axis}", 1)[:, 0] for axis in "xy"]),
        classes=np.array(frame.values(entity, "name"), dtype=np.str_),
        scores=frame.array(entity, "score", 1)[:, 0],
    )
    return RecordedBoxes(_stamp(frame), _pose(frame, origin), boxes)


def _stamp(frame: RecordedFrame) -> FrameStamp:
    scene = frame.values(entities.EGO, "scene")
    time = frame.values(entities.EGO, "timestamp_ns")
    return FrameStamp(frame.index, scene[0] if scene else "", int(time[0]) if time else 0)


def _pose(frame: RecordedFrame, origin: np.ndarray) -> Pose:
    numbers = frame.array(entities.EGO, "pose", 16)
    matrix = numbers[0].reshape(4, 4).copy() if len(numbers) else np.eye(4)
    matrix[:3, 3] += origin
    return Pose.from_matrix(matrix)
