"""The part of a measurement that the drive shows: directions without information stay as stated."""

from dataclasses import dataclass

import numpy as np

from bevcli.calibration.measure import Measurement
from bevcli.calibration.solve import Solution
from bevcli.calibration.unknowns import OF_CAMERA, OF_RIG, Unknowns
from bevcli.geometry.transforms import Array

LEAST_INFORMATION = 3.0  # of a direction, in that of the stated value: the deviation is then halved at least
LEAST_FACTOR = 0.5  # of variances, by which the agreement of the pairs may make them smaller
FINEST = np.array([np.radians(0.01)] * 3 + [0.001] * 3 + [0.001])  # errors of lens and images: radians, metres, seconds


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
    covariance = _honest(unknowns, solution)
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


def _honest(unknowns: Unknowns, solution: Solution) -> Array:
    """The covariance (P, P), each unknown scaled by how well the frame pairs agree about it: the jackknife.

    The result without a pair differs by what that pair pulls. So an unknown that a single pair tells is not believed,
    however small its residuals are.
    """
    prior = np.diag(1 / unknowns.deviations**2)
    matrix = solution.information + prior
    covariance: Array = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    pulls = []
    for pair in range(unknowns.pairs):
        groups = unknowns.groups[:, 0] == pair
        pulls.append(np.linalg.solve(matrix - solution.information_of(groups), solution.gradient_of(groups)))
    agreed = (np.square(pulls).sum(0) + np.diag(covariance @ prior @ covariance)) / np.diag(covariance)
    factor = np.sqrt(np.maximum(agreed, LEAST_FACTOR))
    return covariance * np.outer(factor, factor)
