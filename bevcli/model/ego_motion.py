"""Ego-motion in the model (paper, section 3.4): can-bus numbers, and the shift and rotation of the history map."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.ego_motion import Kinematics
from bevcli.geometry.transforms import Pose, yaw_of_quaternion
from bevcli.model.upload import upload

CAN_BUS_SIZE = 18

# The released code rotates about this cell at every grid size; it is the map's centre only with 200 x 200 cells.
ORIGINAL_ROTATION_CENTER = (100.0, 100.0)

RotationCenter = Literal["original", "center"] | tuple[float, float]


@dataclass(frozen=True)
class EgoMotionConfig:
    """The use of ego-motion in the model.

    The first three are the paper's switches. The others are quirks of the released code, with which its published
    weights were trained.

    Attributes:
        can_bus: whether the can-bus embedding is added to the BEV queries.
        shift: whether the reference points in the history map follow the vehicle's translation.
        rotation: whether the history map is rotated by the change of heading.
        history_shift: "history" shifts the reference points of the history map only, as in the paper; "both" shifts
            those of the current map too, as the released code does because two of its tensors share memory.
        history_rotation_center: "center" of the BEV map; "original" for (100, 100) at every grid size; or (x, y) in
            cells from the map's corner.
        can_bus_quaternion: the quaternion in the can-bus numbers: "wxyz", or "w" for w four times, as in the released
            code.
        first_frame: translation and change of heading in a scene's first frame: "zero"; or "original" for those since
            the last frame of the run, also of another scene, and in the run's first frame since the origin of the
            world, as in the released code of UniAD. They then shift the reference points although there is no history.
    """

    can_bus: bool = True
    shift: bool = True
    rotation: bool = True
    history_shift: Literal["both", "history"] = "both"
    history_rotation_center: RotationCenter = "original"
    can_bus_quaternion: Literal["w", "wxyz"] = "w"
    first_frame: Literal["zero", "original"] = "zero"


@dataclass(frozen=True)
class EgoMotionInputs:
    """The model's ego-motion inputs for one frame."""

    can_bus: np.ndarray  # (18,) float32, the translation and the change of heading since the previous frame included
    shift: np.ndarray  # (2,) float32, translation of the history map (x, y) in normalised BEV coordinates
    rotation_deg: float  # rotation of the history map


def ego_motion_inputs(
    pose: Pose, previous_pose: Pose | None, kinematics: Kinematics, grid: BevGrid, config: EgoMotionConfig
) -> EgoMotionInputs:
    """The model's ego-motion inputs for one frame, computed in float64 as in the released code.

    Args:
        pose: world_from_ego, with the sign of the quaternion as stored.
        previous_pose: world_from_ego of the previous frame. None for a scene's first frame, which has neither
            translation nor rotation, and where config.first_frame is "original" for the first frame of the run.
    """
    if previous_pose is None:
        previous_pose = Pose.identity() if config.first_frame == "original" else pose
    poses = pose, previous_pose
    position, previous_position = (np.asarray(at.translation, dtype=np.float64) for at in poses)
    moved = position - previous_position
    yaw_deg, previous_yaw_deg = (float(np.degrees(yaw_of_quaternion(at.quaternion)) % 360.0) for at in poses)
    # Not wrapped to ±180, as in the training of the published weights: crossing 0 gives about ±360.
    turned_deg = yaw_deg - previous_yaw_deg
    w, x, y, z = np.asarray(pose.quaternion, dtype=np.float64)
    quaternion = [w, w, w, w] if config.can_bus_quaternion == "w" else [w, x, y, z]
    yaws = [np.radians(yaw_deg), turned_deg]
    sensors = (kinematics.acceleration, kinematics.angular_rate, kinematics.velocity)
    can_bus = np.concatenate([moved, quaternion, *sensors, yaws])
    # The translation to the right and ahead of the ego, over the extent of the BEV map.
    distance, angle = np.hypot(moved[0], moved[1]), np.radians(yaw_deg) - np.arctan2(moved[1], moved[0])
    extent_x, extent_y = (end - start for start, end in (grid.x_range_m, grid.y_range_m))
    shift = np.array([distance * np.sin(angle) / extent_x, distance * np.cos(angle) / extent_y])
    return EgoMotionInputs(
        can_bus=can_bus.astype(np.float32),
        shift=(shift * config.shift).astype(np.float32),
        rotation_deg=turned_deg * config.rotation,
    )


def rotate_history(history: Tensor, rotation_deg: Tensor, grid: BevGrid, center: RotationCenter) -> Tensor:
    """BEV maps (B, Y·X, C), rotated; a cell takes the nearest old cell, or zero where that lies outside the map.

    Args:
        history: (B, Y·X, C).
        rotation_deg: (B,); on the CPU it needs no wait for the history's device.
        center: see `EgoMotionConfig.history_rotation_center`.
    """
    return turned_history(history, upload(map_rotation(rotation_deg, grid, center), history.device), grid)


def turned_history(history: Tensor, rotation: Tensor, grid: BevGrid) -> Tensor:
    """The part of `rotate_history` on the history's device. rotation: (B, 2, 3) of `map_rotation`."""
    rows, columns = grid.rows, grid.columns
    by_x, by_y, translation = rotation.unbind(-1)  # (B, 2) each
    x = torch.arange(columns, device=rotation.device) + 0.5 - columns / 2  # (X,)
    y = torch.arange(rows, device=rotation.device) + 0.5 - rows / 2  # (Y,)
    turned = [by_x[:, i, None, None] * x + by_y[:, i, None, None] * y[:, None] for i in (0, 1)]
    source_x, source_y = (coordinate + translation[:, i, None, None] for i, coordinate in enumerate(turned))
    # The old cell that each cell takes its history from, (B, Y, X) int64 each.
    row = (((source_y + 1) * rows - 1) / 2).round().long()
    column = (((source_x + 1) * columns - 1) / 2).round().long()
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    source = (row.clamp(0, rows - 1) * columns + column.clamp(0, columns - 1)).flatten(1)  # (B, Y·X)
    batch = torch.arange(len(history), device=history.device)[:, None]
    return history[batch, source] * inside.flatten(1)[..., None]


def map_rotation(rotation_deg: Tensor, grid: BevGrid, center: RotationCenter) -> Tensor:
    """(B, 2, 3) float32: the columns for x and y and the translation, that turn BEV maps by rotation_deg (B,).

    Computed in float32 and in halves of the map, as the released code's affine grid is, so that both choose the same
    cell where a source lies midway between two.
    """
    half = torch.tensor([grid.columns / 2, grid.rows / 2], device=rotation_deg.device)
    angle = torch.deg2rad(rotation_deg.double())
    rotation = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], -1).unflatten(-1, (2, 2))
    # x and y of the centre of rotation, in cells from the map's corner.
    named = {"original": ORIGINAL_ROTATION_CENTER, "center": (grid.columns / 2, grid.rows / 2)}
    pivot_cells = named[center] if isinstance(center, str) else center
    pivot = torch.tensor(pivot_cells, device=half.device).double() - half
    translation = (pivot - rotation @ pivot).float() / half  # (B, 2)
    scaled = rotation.float() / half[:, None]  # (B, 2, 2)
    return torch.cat([scaled, translation[..., None]], dim=-1)
