"""Rigid transforms as 4x4 float64 matrices `a_from_b`, poses that keep the sign of their quaternion, places on Earth.

Quaternions are (w, x, y, z). Rotations are right-handed; yaw is counter-clockwise about z, 0 along x.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
# The ellipsoid of WGS 84.
EQUATOR_RADIUS_M = 6378137.0
ECCENTRICITY_SQUARED = 6.69437999014e-3
EAST_DEG = 90.0


@dataclass(frozen=True)
class Pose:
    """Position and orientation of frame b in frame a.

    Attributes:
        translation: (3,) metres.
        quaternion: (4,) w, x, y, z of norm 1, with the stored sign: w may be negative.
    """

    translation: Array
    quaternion: Array

    @property
    def matrix(self) -> Array:
        """(4, 4) a_from_b, metres."""
        return rigid(self.translation, rotation_from_quaternion(self.quaternion))

    @property
    def yaw(self) -> float:
        """Yaw in radians, in (-pi, pi]."""
        return yaw_of_quaternion(self.quaternion)

    @staticmethod
    def from_matrix(a_from_b: ArrayLike) -> "Pose":
        """The pose of a rigid matrix (4, 4). Its quaternion has w >= 0."""
        matrix = np.asarray(a_from_b, dtype=np.float64)
        return Pose(matrix[:3, 3].copy(), quaternion_from_rotation(matrix[:3, :3]))

    @staticmethod
    def identity() -> "Pose":
        """The pose in which both frames coincide."""
        return Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


def rigid(translation: ArrayLike = (0, 0, 0), rotation: ArrayLike | None = None) -> Array:
    """(4, 4) a_from_b of a translation (3,) in metres and a rotation (3, 3), identity by default."""
    matrix = np.eye(4)
    matrix[:3, 3] = np.asarray(translation, dtype=np.float64)
    if rotation is not None:
        matrix[:3, :3] = np.asarray(rotation, dtype=np.float64)
    return matrix


def inverse(a_from_b: ArrayLike) -> Array:
    """(..., 4, 4) b_from_a of rigid transforms a_from_b (..., 4, 4)."""
    matrix = np.asarray(a_from_b, dtype=np.float64)
    result = np.zeros_like(matrix)
    rotation = np.swapaxes(matrix[..., :3, :3], -1, -2)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -(rotation @ matrix[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1
    return result


def apply(a_from_b: ArrayLike, points_b: ArrayLike) -> Array:
    """Points (..., 3) in frame b -> the same points (..., 3) in frame a."""
    matrix = np.asarray(a_from_b, dtype=np.float64)
    return np.asarray(points_b, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


def rotation_from_quaternion(quaternion: ArrayLike) -> Array:
    """(3, 3) rotation of a quaternion (w, x, y, z), which is normalised first; (T, 3, 3) of (T, 4)."""
    q = np.asarray(quaternion, dtype=np.float64)
    w, x, y, z = (q / np.linalg.norm(q, axis=-1, keepdims=True)).T
    rows = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.ascontiguousarray(rows.T.swapaxes(-1, -2))  # (T, 3, 3)


def quaternion_from_rotation(rotation: ArrayLike) -> Array:
    """(4,) w, x, y, z with w >= 0 of a rotation (3, 3); (T, 4) of (T, 3, 3).

    By Bar-Itzhack's method, the largest eigenvector.
    """
    r = np.asarray(rotation, dtype=np.float64).swapaxes(-1, -2).T  # (3, 3, T)
    zero = np.zeros_like(r[0, 0])
    k = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], zero, zero, zero],
            [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], zero, zero],
            [r[0, 2] - r[2, 0], r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], zero],
            [r[1, 0] - r[0, 1], r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    vectors = np.linalg.eigh(k.T.swapaxes(-1, -2))[1][..., -1]  # eigh reads the lower triangle
    return np.where(vectors[..., :1] < 0, -vectors, vectors)


def rotation_about_z(yaw: float) -> Array:
    """(3, 3) rotation by `yaw` radians about z, counter-clockwise."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def yaw_of_quaternion(quaternion: ArrayLike) -> float:
    """Yaw in radians, in (-pi, pi], of a quaternion (w, x, y, z) of norm 1."""
    w, x, y, z = np.asarray(quaternion, dtype=np.float64)
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def yaw_of_rotation(rotation: ArrayLike) -> float:
    """Yaw in radians, in (-pi, pi], of the rotated x axis seen from above; rotation: (3, 3)."""
    r = np.asarray(rotation, dtype=np.float64)
    return float(np.arctan2(r[1, 0], r[0, 0]))


def wrap_angle(angle: ArrayLike) -> Array:
    """Angles in radians wrapped to [-pi, pi)."""
    return (np.asarray(angle, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi


def slerp(start: ArrayLike, end: ArrayLike, fraction: float) -> Array:
    """Spherical interpolation of two quaternions (4,) along the shorter arc. The result has the sign of `start`."""
    a, b = (np.asarray(q, dtype=np.float64) for q in (start, end))
    cosine = float(a @ b)
    if cosine < 0:
        b, cosine = -b, -cosine
    angle = np.arccos(min(cosine, 1.0))
    if angle < 1e-8:
        mixed = a + fraction * (b - a)
    else:
        mixed = (np.sin((1 - fraction) * angle) * a + np.sin(fraction * angle) * b) / np.sin(angle)
    return mixed / np.linalg.norm(mixed)


def interpolate(start: Pose, end: Pose, fraction: float) -> Pose:
    """The pose at `fraction` (0 to 1) between two poses: translation linear, rotation by slerp."""
    translation = start.translation + fraction * (end.translation - start.translation)
    return Pose(translation, slerp(start.quaternion, end.quaternion, fraction))


@dataclass(frozen=True)
class GeoOrigin:
    """Place of a drive's world frame on Earth (WGS 84). Its z axis points up."""

    latitude_deg: float  # latitude of the world frame's origin, degrees, north is positive
    longitude_deg: float  # longitude of the origin, degrees, east is positive
    # compass direction of the world's x axis, degrees clockwise from north. 90: x is east, y north
    heading_deg: float = EAST_DEG

    def latitude_longitude(self, points_world: ArrayLike) -> Array:
        """Points (..., 2 or 3) of the world frame, metres -> latitude and longitude (..., 2), degrees.

        The Earth's surface counts as flat around the origin: within 10 km the error is below 20 m, within 1 km below
        20 cm.
        """
        points = np.asarray(points_world, dtype=np.float64)
        steps = points[..., :2] @ self._north_east_from_world.T / self._metres_per_radian
        return np.array([self.latitude_deg, self.longitude_deg]) + np.degrees(steps)

    def points(self, latitude_longitude: ArrayLike) -> Array:
        """Latitude and longitude (..., 2), degrees -> x and y (..., 2) in the world frame, metres; the inverse."""
        degrees = np.asarray(latitude_longitude, dtype=np.float64) - [self.latitude_deg, self.longitude_deg]
        return np.radians(degrees) * self._metres_per_radian @ self._north_east_from_world

    @property
    def _north_east_from_world(self) -> Array:
        heading = np.radians(self.heading_deg)
        return np.array([[np.cos(heading), np.sin(heading)], [np.sin(heading), -np.cos(heading)]])

    @property
    def _metres_per_radian(self) -> Array:
        """Along the meridian, and along the parallel."""
        latitude = np.radians(self.latitude_deg)
        bend = 1 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2
        meridian = EQUATOR_RADIUS_M * (1 - ECCENTRICITY_SQUARED) / bend**1.5
        return np.array([meridian, EQUATOR_RADIUS_M / np.sqrt(bend) * np.cos(latitude)])
