"""Robust least squares over the unknowns, and the covariance of the result.

The unknowns are few (about a hundred) and the residuals many (tens of thousands), so the normal equations are formed
group by group. They are the information matrix, which says what is observed.
"""

from collections.abc import Sequence as Items
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.transforms import Array
from bevcli.workshop.calibration.residuals import Residuals, derivatives, values
from bevcli.workshop.calibration.unknowns import Indices, Unknowns

STEPS = 25
SMALLEST_STEP = 1e-3  # of the deviations before the measurement; a smaller step ends the search
DAMPING = (1e-4, 1e8)  # at the start, and where the search ends without success
DEVIATION = 1.4826  # standard deviation by the median of absolute values
LEAST_CURVATURE = 0.1  # where most residuals are outliers
SMALLEST_PX = 0.05  # a smaller spread of residuals is not believed
FEWEST = 50  # residuals of a camera that tell their spread
# Residuals with their spread, pixels, one or (N,): Cauchy's loss treats those far beyond it as outliers.
Term = tuple[Residuals, float | Array]


@dataclass(frozen=True)
class Solution:
    """The unknowns that fit best.

    Attributes:
        x: (P,) their values.
        columns: (G, 20) the places in x that each group depends on.
        blocks: (G, 20, 20) the information of each group about them.
        gradients: (G, 20) of each group; they sum up to little, and their scatter tells how well the groups agree.
    """

    x: Array
    columns: Indices
    blocks: Array
    gradients: Array

    @property
    def information(self) -> Array:
        """(P, P) of the measurements alone."""
        return self.information_of(np.ones(len(self.columns), dtype=bool))

    def information_of(self, groups: NDArray[np.bool_]) -> Array:
        """(P, P) of some groups, by a mask (G,)."""
        return _summed(self.columns[groups], self.blocks[groups], len(self.x))

    def gradient_of(self, groups: NDArray[np.bool_]) -> Array:
        """(P,) of some groups, by a mask (G,)."""
        return _summed(self.columns[groups], self.gradients[groups], len(self.x))


def solve(unknowns: Unknowns, terms: Items[Term], x: Array) -> Solution:
    """Levenberg and Marquardt's search from x (P,) with Cauchy's loss."""
    prior = 1 / unknowns.deviations**2
    damping, cost = DAMPING[0], _cost(unknowns, terms, x, prior)
    for _ in range(STEPS):
        found = _at(unknowns, terms, x)
        matrix = found.information + np.diag(prior)
        gradient = _summed(found.columns, found.gradients, len(x)) + prior * x
        while damping < DAMPING[1]:
            step = -np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), gradient)
            reached = _cost(unknowns, terms, x + step, prior)
            if reached <= cost:
                break
            damping *= 10
        else:
            break
        x, cost, damping = x + step, reached, max(damping / 10, 1e-9)
        if np.abs(step / unknowns.deviations).max() < SMALLEST_STEP:
            break
    return _at(unknowns, terms, x, curvature=True)


def spread(unknowns: Unknowns, residuals: Residuals, x: Array) -> Array:
    """The standard deviation of the residuals at x, pixels, outliers left out: (N,), that of the camera of each.

    A camera with few residuals has that of all.
    """
    found, camera = np.abs(values(unknowns, residuals, x)), unknowns.groups[residuals.group, 1]
    result = np.full(len(found), DEVIATION * np.median(found) if found.size else 1.0)
    for each in np.unique(camera):
        mine = camera == each
        if mine.sum() >= FEWEST:
            result[mine] = DEVIATION * np.median(found[mine])
    return np.maximum(result, SMALLEST_PX)


def _cost(unknowns: Unknowns, terms: Items[Term], x: Array, prior: Array) -> float:
    cost = float((prior * x**2).sum())
    for residuals, scale in terms:
        squares = (values(unknowns, residuals, x) ** 2).sum(-1) / scale**2
        cost += float(np.log1p(squares).sum())
    return cost


def _at(unknowns: Unknowns, terms: Items[Term], x: Array, *, curvature: bool = False) -> Solution:
    """The normal equations at x (P,), group by group.

    curvature: scale the information of a term by the mean curvature of its loss, as the covariance needs it.
    """
    columns = unknowns.columns
    blocks, gradients = np.zeros((*columns.shape, columns.shape[1])), np.zeros(columns.shape)
    for residuals, scale in terms:
        here, slopes = derivatives(unknowns, residuals, x)
        squares = (here**2).sum(-1) / scale**2
        weights = 1 / (1 + squares) / scale**2
        factor = _curvature(squares) if curvature else 1.0
        bounds = np.searchsorted(residuals.group, np.arange(len(columns) + 1))
        for group, (start, end) in enumerate(pairwise(bounds)):
            part = slopes[start:end].reshape(-1, slopes.shape[-1])
            weighted = part * np.repeat(weights[start:end], here.shape[1])[:, None]
            blocks[group] += factor * part.T @ weighted
            gradients[group] += weighted.T @ here[start:end].ravel()
    return Solution(x, columns, blocks, gradients)


def _summed(columns: Indices, parts: Array, size: int) -> Array:
    """Vectors (G, 20) or matrices (G, 20, 20) of groups summed up in all unknowns: (P,) or (P, P)."""
    if parts.ndim == 2:
        return np.asarray(np.bincount(columns.ravel(), parts.ravel(), size), dtype=np.float64)
    places = columns[:, :, None] * size + columns[:, None, :]
    return np.asarray(np.bincount(places.ravel(), parts.ravel(), size**2), dtype=np.float64).reshape(size, size)


def _curvature(squares: Array) -> float:
    """The mean curvature of Cauchy's loss as a share of the mean weight, for squared residuals (N,) in its scale."""
    if not len(squares):
        return 1.0
    return max(float(np.sum((1 - squares) / (1 + squares) ** 2) / np.sum(1 / (1 + squares))), LEAST_CURVATURE)
