"""The boxes of a recording."""

from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Pose
from bevcli.recording import entities
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes
from bevcli.viewer.recording_reader import RecordedFrame, RecordingReader

MOST_SKEW = 1e-3  # of a rotation: difference of R Rᵀ and the identity


def read_recording(recording: Path) -> BoxesFile:
    """The shown boxes of all frames, in the world frame. Raises InputError for a recording without frames."""
    frames = tuple(recorded_boxes(frame) for frame in RecordingReader(recording).frames())
    if not frames:
        raise InputError(f"{recording}: the recording has no frames with boxes (expected one of `bevcli run`)")
    return BoxesFile("world", frames)


def recorded_boxes(frame: RecordedFrame) -> FrameBoxes:
    """The shown boxes of a frame in the sequence's world frame, highest score first; recordings store float32."""
    entity, world = entities.BOXES, frame.array(entities.WORLD, "origin", 3)
    origin = world[0] if len(world) else np.zeros(3)
    centers = frame.array(entity, "Boxes3D:centers", 3)
    count = len(centers)
    quaternions = frame.array(entity, "Boxes3D:quaternions", 4, count)  # x, y, z, w
    boxes = Boxes3D(
        centers=centers + origin,
        sizes_lwh=2 * frame.array(entity, "Boxes3D:half_sizes", 3, count),
        yaws=2 * np.arctan2(quaternions[:, 2], quaternions[:, 3]),
        velocities=np.hstack([frame.array(entity, f"velocity_{axis}", 1, count, nan=True) for axis in "xy"]),
        classes=np.array(frame.texts(entity, "name", count), dtype=np.str_),
        scores=frame.array(entity, "score", 1, count)[:, 0],
        instances=np.array(frame.texts(entity, "track", count), dtype=np.str_) if frame.has(entity, "track") else None,
    )
    if (boxes.sizes_lwh <= 0).any():
        raise frame.wrong(entity, "Boxes3D:half_sizes", "sizes above 0", boxes.sizes_lwh.min() / 2)
    (time,) = frame.integers(entities.EGO, "timestamp_ns", 1)
    stamp = FrameStamp(frame.index, "".join(frame.texts(entities.EGO, "scene")), time)
    world_from_ego = frame.array(entities.EGO, "pose", 16, 1).reshape(4, 4).copy()
    if abs(world_from_ego[:3, :3] @ world_from_ego[:3, :3].T - np.eye(3)).max() > MOST_SKEW:
        raise frame.wrong(entities.EGO, "pose", "a rotation and a place", "another matrix")
    world_from_ego[:3, 3] += origin
    return FrameBoxes(stamp, Pose.from_matrix(world_from_ego), boxes)
