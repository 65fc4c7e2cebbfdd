"""Stated poses for arithmetic with many times at once."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bevcli.geometry.ego_motion import TOLERANCE_NS, EgoMotion
from bevcli.geometry.transforms import Array, inverse


@dataclass(frozen=True)
class Poses:
    """Poses of T rows, for arithmetic with many times at once."""

    times_ns: NDArray[np.int64]  # (T,) strictly increasing
    rotations: Array  # (T, 3, 3) of world_from_ego
    positions: Array  # (T, 3) metres, world frame

    @cached_property
    def quaternions(self) -> Array:
        """(T, 4) of the rotations, x, y, z, w."""
        return np.asarray(Rotation.from_matrix(self.rotations).as_quat())

    @classmethod
    def of(cls, motion: EgoMotion) -> "Poses":
        """The poses of ego-motion."""
        rotations = Rotation.from_quat(np.roll(motion.quaternions, -1, axis=1)).as_matrix()
        return cls(motion.timestamps_ns, rotations, motion.translations)

    def at(self, times_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        """Poses (..., 4, 4) at times (...), and whether the rows cover them; between rows they are interpolated."""
        covered = (times_ns >= self.times_ns[0] - TOLERANCE_NS) & (times_ns <= self.times_ns[-1] + TOLERANCE_NS)
        last = len(self.times_ns) - 1
        row = np.clip(np.searchsorted(self.times_ns, times_ns, side="right") - 1, 0, max(last - 1, 0))
        later = np.minimum(row + 1, last)
        duration = np.maximum(self.times_ns[later] - self.times_ns[row], 1)  # 0 for a single row
        fraction = np.clip((times_ns - self.times_ns[row]) / duration, 0, 1)[..., None]
        start, end = self.quaternions[row], self.quaternions[later]
        end = np.where((start * end).sum(-1, keepdims=True) < 0, -end, end)
        mixed = start + fraction * (end - start)  # neighbouring rows differ by little
        poses = np.broadcast_to(np.eye(4), (*times_ns.shape, 4, 4)).copy()
        poses[..., :3, :3] = Rotation.from_quat(mixed.reshape(-1, 4)).as_matrix().reshape(*times_ns.shape, 3, 3)
        poses[..., :3, 3] = self.positions[row] + fraction * (self.positions[later] - self.positions[row])
        return poses, covered


def steps_between(poses: Array) -> Array:
    """Steps (..., F - 1, 4, 4), ego_a_from_ego_b, between poses (..., F, 4, 4)."""
    return inverse(poses[..., :-1, :, :]) @ poses[..., 1:, :, :]
