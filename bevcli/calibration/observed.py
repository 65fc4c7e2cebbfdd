"""The part of a measurement that the drive shows: directions without information stay as stated."""

from dataclasses import dataclass

import numpy as np

from bevcli.calibration.measure import Measurement
from bevcli.calibration.unknowns import OF_CAMERA, OF_RIG
from bevcli.geometry.transforms import Array

LEAST_INFORMATION = 3.0  # of a direction, in that of the stated value: the deviation is then halved at least
FINEST = np.array(
    [np.radians(0.015)] * 3 + [0.001] * 3 + [0.001]
)  # errors of lens and images: radians, metres, seconds


@dataclass(frozen=True)
class Observed:
    """The unknowns of the cameras and of the rig.

    Attributes:
        changes: (C, 7) rotation, radians in the camera frame; position, metres in the ego frame; delay, seconds.
        covariances: (C, 7, 7) of the changes; a direction that is not observed has the deviation of the stated value.
        rig: (3,) scale of the ego-motion and slopes of the road.
        rig_deviations: (3,).
        height_m: mean change of the cameras' heights.
        height_deviation_m: of it.
    """

    changes: Array
    covariances: Array
    rig: Array
    rig_deviations: Array
    height_m: float
    height_deviation_m: float


def observed(measurement: Measurement) -> Observed:
    """The changes along directions that are observed, with their covariance."""
    unknowns, solution = measurement.unknowns, measurement.solution
    deviations, count = unknowns.deviations, OF_CAMERA * unknowns.cameras
    inverse: Array = np.asarray(np.linalg.inv(solution.information + np.diag(1 / deviations**2)), dtype=np.float64)
    covariance = _honest(inverse, solution.scatter, deviations)
    scale = deviations[:count]
    marginal = np.linalg.inv(covariance[:count, :count] / np.outer(scale, scale)) - np.eye(count)
    sizes, axes = np.linalg.eigh((marginal + marginal.T) / 2)
    seen, unseen = axes[:, sizes >= LEAST_INFORMATION], axes[:, sizes < LEAST_INFORMATION]
    change = scale * (seen @ (seen.T @ (solution.x[:count] / scale)))
    within = seen @ np.diag(1 / (1 + sizes[sizes >= LEAST_INFORMATION])) @ seen.T + unseen @ unseen.T
    whole = np.outer(scale, scale) * within + np.diag(np.tile(FINEST, unknowns.cameras) ** 2)
    blocks = whole.reshape(unknowns.cameras, OF_CAMERA, unknowns.cameras, OF_CAMERA)
    changes = change.reshape(unknowns.cameras, OF_CAMERA)
    heights = blocks[:, 5, :, 5]
    return Observed(
        changes,
        np.stack([blocks[c, :, c] for c in range(unknowns.cameras)]),
        solution.x[-OF_RIG:],
        np.sqrt(np.diag(covariance)[-OF_RIG:]),
        float(changes[:, 5].mean()),
        float(np.sqrt(heights.sum()) / unknowns.cameras),
    )


def _honest(covariance: Array, scatter: Array, deviations: Array) -> Array:
    """The covariance, enlarged for each unknown where the frame pairs agree less than their residuals promise."""
    agreed = covariance @ (scatter + np.diag(1 / deviations**2)) @ covariance
    factor = np.sqrt(np.maximum(np.diag(agreed) / np.diag(covariance), 1.0))
    return covariance * np.outer(factor, factor)
