"""Residuals: how far matched points, and points of the road, are from where a geometry puts them."""

from abc import ABC, abstractmethod
from collections.abc import Sequence as Items
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.transforms import Array, inverse

Indices = NDArray[np.int64]
SHORTEST = 1e-9


@dataclass(frozen=True)
class GroupGeometry:
    """The geometry of all groups."""

    ego_from_camera_a: Array  # (G, 4, 4)
    ego_from_camera_b: Array  # (G, 4, 4)
    ego_b_from_ego_a: Array  # (G, 4, 4) the motion of the vehicle between the two images
    slopes: Array  # (2,) of the road

    @property
    def camera_b_from_camera_a(self) -> Array:
        """(G, 4, 4)."""
        return inverse(self.ego_from_camera_b) @ self.ego_b_from_ego_a @ self.ego_from_camera_a


@dataclass(frozen=True)
class Residuals(ABC):
    """Measured points of groups, sorted by group."""

    group: Indices  # (N,) the group of each
    rays_a: Array  # (N, 3) unit directions in the camera frame of the first image
    rays_b: Array  # (N, 3) of the same points in that of the second one

    def where(self, kept: NDArray[np.bool_] | Indices) -> Self:
        """Some of the points, by a mask (N,) or by indices."""
        return type(self)(*(getattr(self, field.name)[kept] for field in fields(self)))

    def sorted(self) -> Self:
        """The points by group, as the solver needs them."""
        return self.where(np.argsort(self.group, kind="stable"))

    @abstractmethod
    def of(self, geometry: GroupGeometry) -> Array:
        """(N, D) residuals in pixels of the reduced images, for the geometry of all groups."""


@dataclass(frozen=True)
class EpipolarResiduals(Residuals):
    """The distance of matched points from each other's epipolar lines: the angle between ray and epipolar plane.

    This is Sampson's distance for rays, so that it holds for fisheyes too.
    """

    focal: Array  # (N,) pixels

    def of(self, geometry: GroupGeometry) -> Array:
        """(N, 1) pixels."""
        relative = geometry.camera_b_from_camera_a
        turns, shifts = relative[:, :3, :3], relative[:, :3, 3]
        directions = shifts / np.maximum(np.linalg.norm(shifts, axis=-1, keepdims=True), SHORTEST)
        turned = np.einsum("nij,nj->ni", turns[self.group], self.rays_a)
        direction = directions[self.group]
        normal_a, normal_b = np.cross(direction, turned), np.cross(direction, self.rays_b)
        length = np.sqrt((normal_a**2).sum(-1) + (normal_b**2).sum(-1))
        return (self.focal * (self.rays_b * normal_a).sum(-1) / np.maximum(length, SHORTEST))[:, None]

    def depths(self, geometry: GroupGeometry) -> Array:
        """(N, 2) metres scaled both rays to where they meet, or come nearest to it; 0 for parallel rays."""
        relative = geometry.camera_b_from_camera_a[self.group]
        ray_a, ray_b = np.einsum("nij,nj->ni", relative[:, :3, :3], self.rays_a), self.rays_b
        shift, cosine = relative[:, :3, 3], (ray_a * ray_b).sum(-1)
        along_a, along_b = (shift * ray_a).sum(-1), (shift * ray_b).sum(-1)
        scaled = np.stack([cosine * along_b - along_a, along_b - cosine * along_a], axis=-1)
        return scaled / np.maximum(1 - cosine**2, SHORTEST)[:, None]


@dataclass(frozen=True)
class DepthResiduals(Residuals):
    """The distance of points from where they would be at the depth that two cameras see at one time.

    The rays are of the first camera at the first time and of the second camera at the same time.
    """

    rays_later: Array  # (N, 3) unit directions of the points in the first camera at the second time
    focal: Array  # (N,) pixels

    def of(self, geometry: GroupGeometry) -> Array:
        """(N, 3) pixels."""
        relative = (inverse(geometry.ego_from_camera_b) @ geometry.ego_from_camera_a)[self.group]
        turned = np.cross(self.rays_b, np.einsum("nij,nj->ni", relative[:, :3, :3], self.rays_a))
        shifted = np.cross(self.rays_b, relative[:, :3, 3])
        nearness = -(turned * shifted).sum(-1) / np.maximum(
            (shifted**2).sum(-1), SHORTEST
        )  # 1 / depth; 0 for far points
        pose, motion = geometry.ego_from_camera_a, geometry.ego_b_from_ego_a
        later = (inverse(pose) @ motion @ pose)[self.group]
        ahead = np.einsum("nij,nj->ni", later[:, :3, :3], self.rays_a) + nearness[:, None] * later[:, :3, 3]
        ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
        return self.focal[:, None] * (ahead - self.rays_later)


@dataclass(frozen=True)
class RoadResiduals(Residuals):
    """The distance of road points from where they would be on a flat road.

    The weights turn an error of a ray in the second image into pixels of the first one.
    """

    weights: Array  # (N, 2, 3), less where the image shows no contrast along an axis
    beside_m: Array  # (N,) distance of the points from the way of the vehicle

    def of(self, geometry: GroupGeometry) -> Array:
        """(N, 2) pixels."""
        ahead = rays_of_road_points(geometry, geometry.ego_from_camera_a, self.group, self.rays_a)
        return np.einsum("nij,nj->ni", self.weights, ahead - self.rays_b)


def rays_of_road_points(geometry: GroupGeometry, ego_from_second: Array, group: Indices, rays_a: Array) -> Array:
    """Unit directions (N, 3) in the second image of the points of the road that rays (N, 3) of the first one hit.

    ego_from_second: (G, 4, 4) the cameras of the second images.
    """
    pose, motion, second = (
        matrices[group] for matrices in (geometry.ego_from_camera_a, geometry.ego_b_from_ego_a, ego_from_second)
    )
    start, direction = pose[:, :3, 3], np.einsum("nij,nj->ni", pose[:, :3, :3], rays_a)
    normal = np.array([-geometry.slopes[0], -geometry.slopes[1], 1.0])
    down = direction @ normal
    depth = -(start @ normal) / np.where(down < -SHORTEST, down, -SHORTEST)
    points = start + depth[:, None] * direction
    points = np.einsum("nij,nj->ni", motion[:, :3, :3], points) + motion[:, :3, 3] - second[:, :3, 3]
    points = np.einsum("nji,nj->ni", second[:, :3, :3], points)
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


class Parameters(Protocol):
    """What is estimated: the layout of a vector of unknowns x (P,), which counts from stated values."""

    @property
    def columns(self) -> Indices:
        """(G, K) the indices in x of the unknowns that each group depends on."""
        ...

    @property
    def deviations(self) -> Array:
        """(P,) the standard deviation of each unknown before anything is measured."""
        ...

    def geometry(self, local: Array) -> GroupGeometry:
        """The geometry of all groups. local: (G, K), the values of `columns`."""
        ...


def geometry_at(parameters: Parameters, x: Array) -> GroupGeometry:
    """The geometry of all groups for the values x (P,)."""
    return parameters.geometry(x[parameters.columns])


STEP = 1e-6  # of an unknown, for derivatives


def values(parameters: Parameters, residuals: Residuals, x: Array) -> Array:
    """(N, D) residuals at x."""
    return residuals.of(geometry_at(parameters, x))


def derivatives(parameters: Parameters, residuals: Residuals, x: Array) -> tuple[Array, Array]:
    """Residuals (N, D), and their derivatives (N, D, K) by the unknowns of their group, `Parameters.columns`."""
    local = x[parameters.columns]
    here = residuals.of(parameters.geometry(local))
    steps = STEP * np.eye(local.shape[1])
    columns = [(residuals.of(parameters.geometry(local + step)) - here) / STEP for step in steps]
    return here, np.stack(columns, axis=-1)


STEPS = 25
SMALLEST_STEP = 1e-3  # of the deviations before the measurement; a smaller step ends the search
DAMPING = (1e-4, 1e8)  # at the start, and where the search ends without success
DEVIATION = 1.4826  # standard deviation by the median of absolute values
LEAST_CURVATURE = 0.1  # where most residuals are outliers
SMALLEST_PX = 0.05  # a smaller spread of residuals is not believed
FEWEST = 50  # residuals of a kind that tell their spread
# Residuals with their spread, pixels, one or (N,): Cauchy's loss treats those far beyond it as outliers.
Term = tuple[Residuals, float | Array]


@dataclass(frozen=True)
class Solution:
    """The unknowns that fit best."""

    x: Array  # (P,) their values
    columns: Indices  # (G, K) the indices in x that each group depends on
    blocks: Array  # (G, K, K) the information of each group about them
    gradients: Array  # (G, K) of each group; they sum up to little, and their scatter tells how well the groups agree

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


def solve(parameters: Parameters, terms: Items[Term], x: Array) -> Solution:
    """Levenberg and Marquardt's search from x (P,) with Cauchy's loss."""
    prior = 1 / parameters.deviations**2
    damping, cost = DAMPING[0], _cost(parameters, terms, x, prior)
    for _ in range(STEPS):
        here = _at(parameters, terms, x)
        matrix = here.information + np.diag(prior)
        gradient = _summed(here.columns, here.gradients, len(x)) + prior * x
        while damping < DAMPING[1]:
            step = -np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), gradient)
            reached = _cost(parameters, terms, x + step, prior)
            if reached <= cost:
                break
            damping *= 10
        else:
            break
        x, cost, damping = x + step, reached, max(damping / 10, 1e-9)
        if np.abs(step / parameters.deviations).max() < SMALLEST_STEP:
            break
    return _at(parameters, terms, x, curvature=True)


def spread(parameters: Parameters, residuals: Residuals, x: Array, kinds: Indices) -> Array:
    """The standard deviation of the residuals at x, pixels, outliers left out: (N,), that of the kind of each.

    kinds: (N,) such as the camera of each. A kind with few residuals has the deviation of all.
    """
    sizes = np.abs(values(parameters, residuals, x))
    result = np.full(len(sizes), DEVIATION * np.median(sizes) if sizes.size else 1.0)
    for kind in np.unique(kinds):
        mine = kinds == kind
        if mine.sum() >= FEWEST:
            result[mine] = DEVIATION * np.median(sizes[mine])
    return np.maximum(result, SMALLEST_PX)


def _cost(parameters: Parameters, terms: Items[Term], x: Array, prior: Array) -> float:
    cost = float((prior * x**2).sum())
    for residuals, scale in terms:
        squares = (values(parameters, residuals, x) ** 2).sum(-1) / scale**2
        cost += float(np.log1p(squares).sum())
    return cost


def _at(parameters: Parameters, terms: Items[Term], x: Array, *, curvature: bool = False) -> Solution:
    """The normal equations at x (P,), group by group.

    curvature: scale the information of a term by the mean curvature of its loss, as the covariance needs it.
    """
    columns = parameters.columns
    blocks, gradients = np.zeros((*columns.shape, columns.shape[1])), np.zeros(columns.shape)
    for residuals, scale in terms:
        here, slopes = derivatives(parameters, residuals, x)
        squares = (here**2).sum(-1) / scale**2
        weights = 1 / (1 + squares) / scale**2
        factor = _curvature(squares) if curvature else 1.0
        bounds = np.searchsorted(residuals.group, np.arange(len(columns) + 1))
        for group, (start, end) in enumerate(pairwise(bounds)):
            if start == end:
                continue
            rows = slopes[start:end].reshape(-1, slopes.shape[-1])
            weighted = rows * np.repeat(weights[start:end], here.shape[1])[:, None]
            blocks[group] += factor * rows.T @ weighted
            gradients[group] += weighted.T @ here[start:end].ravel()
    return Solution(x, columns, blocks, gradients)


def _summed(columns: Indices, parts: Array, size: int) -> Array:
    """Vectors (G, K) or matrices (G, K, K) of groups summed up in all unknowns: (P,) or (P, P)."""
    if parts.ndim == 2:
        return np.asarray(np.bincount(columns.ravel(), parts.ravel(), size), dtype=np.float64)
    indices = columns[:, :, None] * size + columns[:, None, :]
    return np.asarray(np.bincount(indices.ravel(), parts.ravel(), size**2), dtype=np.float64).reshape(size, size)


def _curvature(squares: Array) -> float:
    """The mean curvature of Cauchy's loss as a share of the mean weight, for squared residuals (N,) in its scale."""
    if not len(squares):
        return 1.0
    return max(float(np.sum((1 - squares) / (1 + squares) ** 2) / np.sum(1 / (1 + squares))), LEAST_CURVATURE)


LEAST_FACTOR = 0.5  # of variances, by which the agreement of the parts may make them smaller


def honest_covariance(parameters: Parameters, solution: Solution, parts: Indices) -> Array:
    """The covariance (P, P), each unknown scaled by how well parts of the measurement agree about it: the jackknife.

    parts: (G,) the part of each group, such as a pair of frames. The result without a part differs by what that part
    pulls. So an unknown that a single part tells is not believed, however small its residuals are.
    """
    prior = np.diag(1 / parameters.deviations**2)
    matrix = solution.information + prior
    covariance: Array = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    pulls = []
    for number in np.unique(parts):
        groups = parts == number
        pulls.append(np.linalg.solve(matrix - solution.information_of(groups), solution.gradient_of(groups)))
    agreed = (np.square(pulls).sum(0) + np.diag(covariance @ prior @ covariance)) / np.diag(covariance)
    factor = np.sqrt(np.maximum(agreed, LEAST_FACTOR))
    return covariance * np.outer(factor, factor)
