"""What stated poses are compared by: measured steps with their deviations."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bevcli.geometry.transforms import Array
from bevcli.workshop.odometry.measure import MeasuredMotion

WIDEST = np.radians(2.0), 0.2, 0.3  # deviations of a step that counts as measured: yaw; length in its own, or metres
# Deviations of sound poses: roll, pitch and yaw of a step; its translation, and that in its length.
POSE_DEVIATIONS, LENGTH_DEVIATION = np.array([np.radians(1.0)] * 2 + [np.radians(0.1)] + [0.02, 0.02, 0.1]), 0.01
FREEDOMS = 6  # of a step


@dataclass(frozen=True)
class MeasuredSteps:
    """K measured steps, and how far other steps are from them in standard deviations."""

    times_ns: NDArray[np.int64]  # (K + 1,) of the frames
    poses: Array  # (K + 1, 4, 4) world_from_ego
    steps: Array  # (K, 4, 4)
    precisions: Array  # (K, 6, 6) of the difference to a sound stated step
    is_used: NDArray[np.bool_]  # (K,) measured well, and covered by the stated poses

    @classmethod
    def of(cls, motion: MeasuredMotion) -> "MeasuredSteps":
        """The steps of a measured motion; those without a reason and with small deviations are used."""
        steps = np.stack([step.ego_a_from_ego_b for step in motion.steps])
        covariances = np.stack([step.covariance for step in motion.steps])
        lengths = np.linalg.norm(steps[:, :3, 3], axis=1)
        deviations = np.broadcast_to(POSE_DEVIATIONS, (len(steps), 6)).copy()
        deviations[:, 3:5] = np.hypot(deviations[:, 3:5], LENGTH_DEVIATION * lengths[:, None])
        yaw, share, metres = WIDEST
        spread = np.sqrt(covariances[:, 3, 3] + covariances[:, 4, 4])
        is_used = (np.sqrt(covariances[:, 2, 2]) < yaw) & (spread < np.maximum(share * lengths, metres))
        is_used &= [not step.reason for step in motion.steps]
        precisions = np.linalg.inv(covariances + np.einsum("ki,ij->kij", deviations**2, np.eye(6)))
        return cls(motion.timestamps_ns, motion.poses, steps, precisions, is_used)

    def differences(self, steps: Array) -> Array:
        """(..., K, 6) rotation and translation of steps (..., K, 4, 4) minus the measured ones."""
        turns = steps[..., :3, :3] @ np.swapaxes(self.steps[:, :3, :3], 1, 2)
        vectors = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec().reshape(*steps.shape[:-2], 3)
        return np.concatenate([vectors, steps[..., :3, 3] - self.steps[:, :3, 3]], axis=-1)

    def distances(self, steps: Array) -> Array:
        """(..., K) the length of the differences in standard deviations."""
        return np.sqrt(self.squared(self.differences(steps)))

    def squared(self, differences: Array) -> Array:
        """(..., K) squared distances of differences (..., K, 6)."""
        return np.einsum("...ki,kij,...kj->...k", differences, self.precisions, differences)

    def cost(self, distances: Array, is_used: NDArray[np.bool_] | None = None) -> Array:
        """(...) robust cost of distances (..., K): that of the steps in use, times the number of all that are used."""
        used = self.is_used if is_used is None else self.is_used & is_used
        of_used = np.where(used, FREEDOMS * np.log1p(distances**2 / FREEDOMS), 0).sum(-1)
        return of_used * self.is_used.sum() / np.maximum(used.sum(-1), 1)

    def weights(self, squared: Array) -> Array:
        """(..., K) robust weights of squared distances."""
        return self.is_used / (1 + squared / FREEDOMS)
