"""The vehicle's poses and kinematics over time, with interpolation between the stored times."""

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array, Pose, interpolate, rotation_from_quaternion

GRAVITY = 9.81  # m/s², the reading of an accelerometer at rest along z
TOLERANCE_NS = 50_000_000  # a time this far outside the stored range is accepted: the motion goes on there
STEADY_NS = 100_000_000  # least time between the poses that tell it: of closer ones the noise would be too large
ROAD_S = 5.0  # the mean of the vehicle's upward axis over this time before and after is taken for the road's
BLOCK, AROUND = 65_536, 2  # rows whose motion is derived at once, and rows around them: of a difference of differences
LONGEST_S = 0.5  # that a pose counts for in that mean


@dataclass(frozen=True)
class Kinematics:
    """Motion of the vehicle at one time, in the ego frame.

    Attributes:
        acceleration: (3,) m/s², including gravity as an accelerometer measures it.
        angular_rate: (3,) rad/s.
        velocity: (3,) m/s.
    """

    acceleration: Array
    angular_rate: Array
    velocity: Array


@dataclass(frozen=True)
class EgoMotion:
    """Poses world_from_ego and kinematics at T times."""

    timestamps_ns: NDArray[np.int64]  # (T,) int64, strictly increasing
    translations: Array  # (T, 3) metres, world frame
    quaternions: Array  # (T, 4) w, x, y, z, with the stored sign
    accelerations: Array  # (T, 3) m/s² with gravity, ego frame
    angular_rates: Array  # (T, 3) rad/s, ego frame
    velocities: Array  # (T, 3) m/s, ego frame
    # whether they come from the input; if not, they are derived from the poses
    velocities_are_stated: bool = field(default=True, kw_only=True)
    # (T, 3) unit vectors that point up from the road, ego frame; None: they are derived from the poses
    road_normals: Array | None = field(default=None, kw_only=True)

    @property
    def first_ns(self) -> int:
        """Time of the first pose."""
        return int(self.timestamps_ns[0])

    @property
    def last_ns(self) -> int:
        """Time of the last pose."""
        return int(self.timestamps_ns[-1])

    def of_rows(self, rows: NDArray[np.int64]) -> "EgoMotion":
        """The poses and kinematics of some rows, by their increasing indices."""
        columns = {column.name: getattr(self, column.name) for column in fields(self)}
        chosen: dict[str, Any] = {name: x[rows] for name, x in columns.items() if isinstance(x, np.ndarray)}
        return replace(self, **chosen)

    def covered(self, timestamps_ns: ArrayLike) -> NDArray[np.bool_]:
        """Whether each time is in the stored range, or at most 50 ms outside of it."""
        times = np.asarray(timestamps_ns, dtype=np.int64)
        return (times >= self.first_ns - TOLERANCE_NS) & (times <= self.last_ns + TOLERANCE_NS)

    def pose_at(self, timestamp_ns: int) -> Pose:
        """world_from_ego at a time. The pose of an exactly matching row is returned unchanged.

        Translation is interpolated linearly, rotation by slerp; outside the stored range both go on as they were (see
        `rows_around`).
        Raises InputError if the time is more than 50 ms outside the stored range.
        """
        row, later, fraction = self._locate(timestamp_ns)
        start = Pose(self.translations[row], self.quaternions[row])
        if fraction == 0:
            return start
        return interpolate(start, Pose(self.translations[later], self.quaternions[later]), fraction)

    def kinematics_at(self, timestamp_ns: int) -> Kinematics:
        """Acceleration, angular rate and velocity at a time, interpolated linearly. Raises InputError as `pose_at`."""
        row, later, fraction = self._locate(timestamp_ns)
        fraction = min(max(fraction, 0.0), 1.0)
        columns = self.accelerations, self.angular_rates, self.velocities
        return Kinematics(*(column[row] + fraction * (column[later] - column[row]) for column in columns))

    def road_normal_at(self, timestamp_ns: int) -> Array:
        """(3,) unit vector that points up from the road, ego frame at a time.

        Where it is not measured, the road is as the vehicle stands on the mean, over which the body pitches and rolls:
        what poses state against gravity may be the slope of the road. Raises InputError as `pose_at`.
        """
        row, later, fraction = self._locate(timestamp_ns)
        normal = self._road_normals[later if fraction > 0.5 else row]
        return np.asarray(rotation_from_quaternion(self.pose_at(timestamp_ns).quaternion).T @ normal)

    @cached_property
    def _road_normals(self) -> Array:
        """(T, 3) in the world frame."""
        if self.road_normals is not None:
            return np.einsum("tij,tj->ti", rotation_from_quaternion(self.quaternions), self.road_normals)
        blocks = range(0, len(self.timestamps_ns), BLOCK)  # all rotations of a long drive at once would fill the memory
        parts = [rotation_from_quaternion(self.quaternions[row : row + BLOCK])[:, :, 2] for row in blocks]
        seconds, upward = (self.timestamps_ns - self.first_ns) / 1e9, np.concatenate(parts)
        weights = np.minimum(np.gradient(seconds), LONGEST_S) if len(seconds) > 1 else np.ones(1)
        sums = np.concatenate([np.zeros((1, 3)), np.cumsum(weights[:, None] * upward, axis=0)])
        begin, end = np.searchsorted(seconds, seconds - ROAD_S), np.searchsorted(seconds, seconds + ROAD_S, "right")
        normals = sums[end] - sums[begin]
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def _locate(self, timestamp_ns: int) -> tuple[int, int, float]:
        if not self.covered(timestamp_ns):
            raise InputError(
                f"ego-motion covers {self.first_ns} to {self.last_ns} ns, but an image or frame is at {timestamp_ns} "
                "ns (at most 50 ms outside is allowed): add ego-motion for that time, or remove the frame"
            )
        (row,), (later,), (fraction,) = rows_around(self.timestamps_ns, np.array([timestamp_ns]))
        return int(row), int(later), float(fraction)


def rows_around(
    times_ns: NDArray[np.int64], wanted_ns: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Two rows of poses at increasing times (T,) around wanted ones (...), and where these lie: 0 to 1 between them.

    Before the first row (below 0) or after the last (above 1), they are this row and the nearest one that is at least
    `STEADY_NS` away from it.
    """
    last = len(times_ns) - 1
    row = np.searchsorted(times_ns, wanted_ns, side="right") - 1
    row = np.where(wanted_ns > times_ns[-1], np.searchsorted(times_ns[1:], times_ns[-1] - STEADY_NS, "right"), row)
    later = np.where(row < 0, np.searchsorted(times_ns, times_ns[0] + STEADY_NS), row + 1)
    later = np.minimum(np.where(wanted_ns > times_ns[-1], last, later), last)
    row = np.maximum(row, 0)
    return row, later, (wanted_ns - times_ns[row]) / np.maximum(times_ns[later] - times_ns[row], 1)


def nearest(times: NDArray[Any], targets: ArrayLike) -> NDArray[np.int64]:
    """(...) the index of the time nearest to each wanted one (...), the earlier of two. times: (T,), increasing."""
    later = np.clip(np.searchsorted(times, targets), 1, max(len(times) - 1, 1))
    earlier, later = later - 1, np.minimum(later, len(times) - 1)
    return np.where(targets - times[earlier] <= times[later] - targets, earlier, later)


def derive_kinematics(
    timestamps_ns: NDArray[np.int64], translations: Array, quaternions: Array
) -> tuple[Array, Array, Array]:
    """Accelerations with gravity, angular rates and velocities from T poses: each (T, 3) in the ego frame.

    They are finite differences over time. A single pose gives no motion: gravity only.

    timestamps_ns: (T,). translations: (T, 3) metres, world frame. quaternions: (T, 4) w, x, y, z.
    """
    count, seconds = len(timestamps_ns), (timestamps_ns - timestamps_ns[0]) / 1e9
    if count <= BLOCK:
        return _kinematics(seconds, translations, quaternions)
    blocks = []
    for row in range(0, count, BLOCK):  # with the rows before and after that the differences take
        rows = slice(max(row - AROUND, 0), row + BLOCK + AROUND)
        kept = slice(row - rows.start, row - rows.start + BLOCK)
        made = _kinematics(seconds[rows], translations[rows], quaternions[rows])
        blocks.append([column[kept] for column in made])
    accelerations, rates, velocities = map(np.concatenate, zip(*blocks, strict=True))
    return accelerations, rates, velocities


def _kinematics(seconds: Array, translations: Array, quaternions: Array) -> tuple[Array, Array, Array]:
    count, rotations = len(seconds), rotation_from_quaternion(quaternions)
    gravity = np.array([0.0, 0.0, GRAVITY])
    if count < 2:
        return np.einsum("tji,j->ti", rotations, gravity), np.zeros((count, 3)), np.zeros((count, 3))
    velocity = np.gradient(translations, seconds, axis=0)
    acceleration = np.gradient(velocity, seconds, axis=0) + gravity
    derivative = np.gradient(rotations, seconds, axis=0)
    skew = np.einsum("tji,tjk->tik", rotations, derivative)  # R^T dR/dt, skew up to discretisation
    rates = np.stack(
        [skew[:, 2, 1] - skew[:, 1, 2], skew[:, 0, 2] - skew[:, 2, 0], skew[:, 1, 0] - skew[:, 0, 1]], axis=-1
    )
    accelerations, velocities = (np.einsum("tji,tj->ti", rotations, vectors) for vectors in (acceleration, velocity))
    return accelerations, rates / 2, velocities
