"""What BEVFormer is told about the vehicle's motion: can-bus numbers, history shift and history rotation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.transforms import Array, Pose, yaw_of_quaternion

CAN_BUS_SIZE = 18

RotationCenter = Literal["original", "center"] | tuple[float, float]


@dataclass(frozen=True)
class EgoMotionConfig:
    """How ego-motion enters the model.

    can_bus, shift, rotation: the paper's switches: can-bus numbers are added to the BEV queries; history is
    looked up where the vehicle's translation moved it; the history map is rotated by the change of heading.
    The rest are quirks of the original, which its published weights were trained with.
    history_shift: "history" shifts the reference points of the history map only, as the paper means it;
    "both" those of the current map too, as an aliasing in the released code does.
    history_rotation_center: "center" of the BEV map; "original" is (100, 100) at every grid size; or (x, y)
    in cells.
    can_bus_quaternion: "wxyz", or "w": w four times, by an accident of the original.
    """

    can_bus: bool = True
    shift: bool = True
    rotation: bool = True
    history_shift: Literal["both", "history"] = "both"
    history_rotation_center: RotationCenter = "original"
    can_bus_quaternion: Literal["w", "wxyz"] = "w"


@dataclass(frozen=True)
class EgoMotionInputs:
    """can_bus: (18,) float32, after the differencing. rotation_deg: of the history map.

    shift: (2,) float32, x and y, in normalised BEV coordinates.
    """

    can_bus: np.ndarray
    shift: np.ndarray
    rotation_deg: float


def ego_motion_inputs(
    pose: Pose,
    previous_pose: Pose | None,
    acceleration: ArrayLike,
    angular_rate: ArrayLike,
    velocity: ArrayLike,
    grid: BevGrid,
    config: EgoMotionConfig,
) -> EgoMotionInputs:
    """The model's ego-motion inputs for one frame; arithmetic in float64, as in the original.

    pose and previous_pose are world_from_ego, with the quaternion's stored sign. previous_pose is that of the
    previous frame of the same scene; None on a scene's first frame: then nothing has moved.
    acceleration (3,) m/s², angular_rate (3,) rad/s and velocity (3,) m/s are in the ego frame.
    """
    position = np.asarray(pose.translation, dtype=np.float64)
    yaw_deg = heading_deg(pose.quaternion)
    moved, turned_deg = np.zeros(3), 0.0
    if previous_pose is not None:
        moved = position - np.asarray(previous_pose.translation, dtype=np.float64)
        # Not unwrapped: crossing north yields about ±360, as the original's weights saw in training.
        turned_deg = yaw_deg - heading_deg(previous_pose.quaternion)
    w, x, y, z = np.asarray(pose.quaternion, dtype=np.float64)
    quaternion = [w, w, w, w] if config.can_bus_quaternion == "w" else [w, x, y, z]
    yaws = [np.radians(yaw_deg), turned_deg]
    can_bus = np.concatenate([moved, quaternion, acceleration, angular_rate, velocity, yaws])
    return EgoMotionInputs(
        can_bus=can_bus.astype(np.float32),
        shift=(_history_shift(moved, yaw_deg, grid) * config.shift).astype(np.float32),
        rotation_deg=turned_deg * config.rotation,
    )


def heading_deg(quaternion: ArrayLike) -> float:
    """Yaw of a pose in degrees, in [0, 360), from its quaternion (4,) w, x, y, z."""
    return float(np.degrees(yaw_of_quaternion(quaternion)) % 360.0)


def _history_shift(moved: Array, yaw_deg: float, grid: BevGrid) -> Array:
    """A translation (3,) in world metres as (2,) right and ahead of the ego, in shares of the BEV's extent."""
    distance = np.hypot(moved[0], moved[1])
    angle = np.radians(yaw_deg) - np.arctan2(moved[1], moved[0])
    extent_x = grid.x_range_m[1] - grid.x_range_m[0]
    extent_y = grid.y_range_m[1] - grid.y_range_m[0]
    return np.array([distance * np.sin(angle) / extent_x, distance * np.cos(angle) / extent_y])
