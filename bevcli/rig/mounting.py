"""The mounting of a camera on the vehicle: position, yaw, pitch, roll, field of view, and its horizon."""

from dataclasses import dataclass

import numpy as np

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array

_STEP_DEG = 0.1
_ANGLES = np.radians(np.arange(-90 + _STEP_DEG / 2, 90, _STEP_DEG))


@dataclass(frozen=True)
class Mounting:
    """Position and angles of a camera in the ego frame.

    Attributes:
        position: (3,), metres.
        yaw_deg: viewing direction, counter-clockwise from straight ahead.
        pitch_deg: positive upwards.
        roll_deg: positive when the camera leans to its right; 180 is upside down.
    """

    position: Array
    yaw_deg: float
    pitch_deg: float
    roll_deg: float

    @property
    def height(self) -> float:
        """Height above the ground plane of the ego frame, metres."""
        return float(self.position[2])


def mounting_of(ego_from_camera: Array) -> Mounting:
    """The mounting of a camera with this pose (4, 4)."""
    right, down, forward = ego_from_camera[:3, 0], ego_from_camera[:3, 1], ego_from_camera[:3, 2]
    return Mounting(
        position=ego_from_camera[:3, 3],
        yaw_deg=float(np.degrees(np.arctan2(forward[1], forward[0]))),
        pitch_deg=float(np.degrees(np.arcsin(np.clip(forward[2], -1, 1)))),
        roll_deg=float(np.degrees(np.arctan2(-right[2], -down[2]))),
    )


def degrees_text(angle_deg: float, digits: int = 1) -> str:
    """An angle as text, such as "0.4°"; zero has no sign."""
    return f"{round(angle_deg, digits) + 0.0:.{digits}f}°"


def seen_fov_deg(camera: Camera) -> tuple[float, float]:
    """Horizontal and vertical field of view through the optical axis, in degrees, lens distortion included.

    At most 180, because points behind the camera's plane are not projected.
    """
    (left, right), (up, down) = seen_range_deg(camera, 0), seen_range_deg(camera, 1)
    return right - left, down - up


def seen_range_deg(camera: Camera, axis: int) -> tuple[float, float]:
    """Smallest and largest angle to the optical axis that is inside the image, degrees.

    axis: 0 counts angles to the right, 1 downwards. (0, 0) where no ray is inside the image.
    """
    rays = np.zeros((len(_ANGLES), 3))
    rays[:, axis], rays[:, 2] = np.sin(_ANGLES), np.cos(_ANGLES)
    pixels, _ = camera.project(rays)
    size = (camera.width, camera.height)[axis]
    with np.errstate(invalid="ignore"):
        inside = (pixels[:, axis] > 0) & (pixels[:, axis] < size)
    seen = np.degrees(_ANGLES[inside])
    if len(seen) == 0:
        return 0.0, 0.0
    return float(seen[0]) - _STEP_DEG / 2, float(seen[-1]) + _STEP_DEG / 2


def horizon(camera: Camera) -> Array:
    """(P, 2) pixels of points 100 km away at the camera's own height; NaN where they are outside the image."""
    yaws = np.radians(np.arange(0, 360, 0.25))
    far = np.stack([np.cos(yaws), np.sin(yaws), np.zeros_like(yaws)], axis=-1) * 1e5
    pixels, depth = camera.project_ego(far + camera.ego_from_camera[:3, 3])
    seen = np.where(camera.contains(pixels, depth)[:, None], pixels, np.nan)
    start = int(np.argmax(depth < 0))  # start behind the camera, so that the line is not cut inside the image
    return np.roll(seen, -start, axis=0)
