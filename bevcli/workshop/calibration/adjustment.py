"""The bundle adjustment of a calibration: the unknowns as one vector, residuals, and robust least squares.

The unknowns are few (about a hundred) and the residuals many (tens of thousands), so the normal equations are formed
group by group. They are the information matrix, which says what is observed.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence as Items
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bevcli.geometry.transforms import Array, inverse

Indices = NDArray[np.int64]
OF_CAMERA = 7  # unknowns: rotation, position, delay
HEIGHT = 5  # index of a camera's height among them
OF_PAIR = 3  # the error of the vehicle's rotation
OF_RIG = 3  # scale of the ego-motion, slope of the road along x and y
DELAYS_S = np.linspace(-0.3, 0.3, 25)  # of a camera's capture times, where the motion of a pair is tabulated


@dataclass(frozen=True)
class Unknowns:
    """The layout of the vector of unknowns, x, and the stated values from which it counts.

    x holds for each camera its rotation (3, radians, in the camera frame), position (3, metres, in the ego frame) and
    delay (seconds); for each pair the rotation of the vehicle (3, radians); at last the scale of the ego-motion (a
    share), and the slopes of the road along x and y of the ego frame. Poses are quaternions (x, y, z, w) and
    translations.
    """

    stated: Array  # (C, 4, 4) ego_from_camera
    poses: Array  # (G, 2, 25, 7) world_from_ego of both images of a group, by delay
    groups: Indices  # (G, 3) pair, camera of the first image and camera of the second one
    pairs: int
    deviations: Array  # (P,) the standard deviation of each unknown before anything is measured

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return len(self.stated)

    @cached_property
    def within_camera(self) -> Indices:
        """The groups whose images are of the same camera."""
        return np.flatnonzero(self.groups[:, 1] == self.groups[:, 2])

    @cached_property
    def columns(self) -> Indices:
        """(G, 20) the indices in x of the unknowns that a group depends on: two cameras, the pair, and the rig."""
        pair, first, second = self.groups.T[..., None]
        start, rig = OF_CAMERA * self.cameras, OF_CAMERA * self.cameras + OF_PAIR * self.pairs
        of_rig = np.broadcast_to(rig + np.arange(OF_RIG), (len(self.groups), OF_RIG))
        cameras = [OF_CAMERA * index + np.arange(OF_CAMERA) for index in (first, second)]
        return np.concatenate([*cameras, start + OF_PAIR * pair + np.arange(OF_PAIR), of_rig], axis=-1)

    def of_camera(self, x: Array) -> Array:
        """(C, 7) rotation, position and delay of each camera."""
        return x[: OF_CAMERA * self.cameras].reshape(self.cameras, OF_CAMERA)


def moved(ego_from_camera: Array, change: Array) -> Array:
    """Poses (C, 4, 4) with a change (C, 6 or 7): rotation in the camera frame, radians; position in ego, metres."""
    result = ego_from_camera.copy()
    result[:, :3, :3] = ego_from_camera[:, :3, :3] @ Rotation.from_rotvec(change[:, :3]).as_matrix()
    result[:, :3, 3] += change[:, 3:6]
    return result


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


def geometry_at(unknowns: Unknowns, x: Array) -> GroupGeometry:
    """The geometry of all groups for the values x (P,)."""
    return geometry(unknowns, x[unknowns.columns])


def geometry(unknowns: Unknowns, local: Array) -> GroupGeometry:
    """The geometry of all groups. local: (G, 20), the values of `Unknowns.columns`."""
    of_a, of_b, pair, rig = np.split(local, np.cumsum([OF_CAMERA, OF_CAMERA, OF_PAIR]), axis=-1)
    (_, first, second), stated = unknowns.groups.T, unknowns.stated
    before, after = (_pose_at(unknowns.poses[:, side], camera[:, 6]) for side, camera in enumerate((of_a, of_b)))
    motion = inverse(after) @ before
    motion[:, :3, :3] = motion[:, :3, :3] @ Rotation.from_rotvec(pair).as_matrix()
    motion[:, :3, 3] *= 1 + rig[:, :1]
    return GroupGeometry(moved(stated[first], of_a), moved(stated[second], of_b), motion, rig[0, 1:])


def _pose_at(table: Array, delay: Array) -> Array:
    """(G, 4, 4) poses of tables (G, 25, 7) at delays (G,), seconds."""
    index = (delay - DELAYS_S[0]) / (DELAYS_S[1] - DELAYS_S[0])
    before = np.clip(index.astype(int), 0, len(DELAYS_S) - 2)
    share, every = (index - before)[:, None], np.arange(len(table))
    pose = (1 - share) * table[every, before] + share * table[every, before + 1]
    result = np.tile(np.eye(4), (len(table), 1, 1))
    result[:, :3, :3] = Rotation.from_quat(pose[:, :4]).as_matrix()
    result[:, :3, 3] = pose[:, 4:]
    return result


STEP = 1e-6  # of an unknown, for derivatives
SHORTEST = 1e-9


@dataclass(frozen=True)
class Residuals(ABC):
    """Measured points of groups, sorted by group."""

    group: Indices  # (N,) the group of each
    rays_a: Array  # (N, 3) unit directions in the camera frame of the first image
    rays_b: Array  # (N, 3) of the same points in that of the second one

    def where(self, kept: NDArray[np.bool_]) -> Self:
        """Some of the points, by a mask (N,)."""
        return type(self)(*(getattr(self, field.name)[kept] for field in fields(self)))

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
class RoadResiduals(Residuals):
    """The distance of road points from where they would be on a flat road.

    The weights turn an error of a ray in the second image into pixels of the first one.
    """

    weights: Array  # (N, 2, 3), less where the image shows no contrast along an axis
    beside_m: Array  # (N,) distance of the points from the way of the vehicle

    def of(self, geometry: GroupGeometry) -> Array:
        """(N, 2) pixels."""
        ahead = rays_of_road_points(geometry, self.group, self.rays_a)
        return np.einsum("nij,nj->ni", self.weights, ahead - self.rays_b)


def rays_of_road_points(geometry: GroupGeometry, group: Indices, rays_a: Array) -> Array:
    """Unit directions (N, 3) in the second image of the points of the road that rays (N, 3) of the first one hit."""
    pose, motion = geometry.ego_from_camera_a[group], geometry.ego_b_from_ego_a[group]
    start, direction = pose[:, :3, 3], np.einsum("nij,nj->ni", pose[:, :3, :3], rays_a)
    normal = np.array([-geometry.slopes[0], -geometry.slopes[1], 1.0])
    down = direction @ normal
    depth = -(start @ normal) / np.where(down < -SHORTEST, down, -SHORTEST)
    points = start + depth[:, None] * direction
    points = np.einsum("nij,nj->ni", motion[:, :3, :3], points) + motion[:, :3, 3] - start
    points = np.einsum("nji,nj->ni", pose[:, :3, :3], points)
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


def values(unknowns: Unknowns, residuals: Residuals, x: Array) -> Array:
    """(N, D) residuals at x."""
    return residuals.of(geometry_at(unknowns, x))


def derivatives(unknowns: Unknowns, residuals: Residuals, x: Array) -> tuple[Array, Array]:
    """Residuals (N, D), and their derivatives (N, D, 20) by the unknowns of their group, `Unknowns.columns`."""
    local = x[unknowns.columns]
    here = residuals.of(geometry(unknowns, local))
    steps = STEP * np.eye(local.shape[1])
    columns = [(residuals.of(geometry(unknowns, local + step)) - here) / STEP for step in steps]
    return here, np.stack(columns, axis=-1)


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
    """The unknowns that fit best."""

    x: Array  # (P,) their values
    columns: Indices  # (G, 20) the indices in x that each group depends on
    blocks: Array  # (G, 20, 20) the information of each group about them
    gradients: Array  # (G, 20) of each group; they sum up to little, and their scatter tells how well the groups agree

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
        here = _at(unknowns, terms, x)
        matrix = here.information + np.diag(prior)
        gradient = _summed(here.columns, here.gradients, len(x)) + prior * x
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
    sizes, camera = np.abs(values(unknowns, residuals, x)), unknowns.groups[residuals.group, 1]
    result = np.full(len(sizes), DEVIATION * np.median(sizes) if sizes.size else 1.0)
    for index in np.unique(camera):
        mine = camera == index
        if mine.sum() >= FEWEST:
            result[mine] = DEVIATION * np.median(sizes[mine])
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
    indices = columns[:, :, None] * size + columns[:, None, :]
    return np.asarray(np.bincount(indices.ravel(), parts.ravel(), size**2), dtype=np.float64).reshape(size, size)


def _curvature(squares: Array) -> float:
    """The mean curvature of Cauchy's loss as a share of the mean weight, for squared residuals (N,) in its scale."""
    if not len(squares):
        return 1.0
    return max(float(np.sum((1 - squares) / (1 + squares) ** 2) / np.sum(1 / (1 + squares))), LEAST_CURVATURE)


SMALLEST_TURN = np.radians(0.005)  # of it
LEAST_FACTOR = 0.5  # of variances, by which the agreement of the pairs may make them smaller


def with_estimated_turns(unknowns: Unknowns, solution: Solution) -> Unknowns:
    """The unknowns with the deviation of the vehicle's stated rotation that its pairs show, at most the present one.

    It is estimated an axis, as the scatter of the solution over what the pairs determine (MacKay's rule).
    """
    deviations = unknowns.deviations.copy()
    start = OF_CAMERA * unknowns.cameras
    turns = slice(start, start + OF_PAIR * unknowns.pairs)
    covariance = np.linalg.inv(solution.information + np.diag(1 / deviations**2))
    determined = (1 - np.diag(covariance)[turns] / deviations[turns] ** 2).reshape(-1, OF_PAIR).sum(0)
    squares = (solution.x[turns] ** 2).reshape(-1, OF_PAIR).sum(0)
    estimated = np.maximum(np.sqrt(squares / np.maximum(determined, 1)), SMALLEST_TURN)
    deviations[turns] = np.minimum(deviations[turns], np.tile(estimated, unknowns.pairs))
    return replace(unknowns, deviations=deviations)


def honest_covariance(unknowns: Unknowns, solution: Solution) -> Array:
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
