"""What is measured against what the unknowns predict: matched points, and points of the road."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.transforms import Array
from bevcli.workshop.calibration.unknowns import GroupGeometry, Indices, Unknowns, geometry, geometry_at

STEP = 1e-6  # of an unknown, for derivatives
SHORTEST = 1e-9


@dataclass(frozen=True)
class Residuals(ABC):
    """Measured points of groups, sorted by group.

    Attributes:
        group: (N,) the group of each.
        rays_a: (N, 3) unit directions in the camera frame of the first image.
        rays_b: (N, 3) of the same points in that of the second one.
    """

    group: Indices
    rays_a: Array
    rays_b: Array

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

    Attributes:
        focal: (N,) pixels.
    """

    focal: Array

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
        """(N, 2) metres along both rays to where they meet, or come nearest to it; 0 for parallel rays."""
        relative = geometry.camera_b_from_camera_a[self.group]
        ray_a, ray_b = np.einsum("nij,nj->ni", relative[:, :3, :3], self.rays_a), self.rays_b
        shift, cosine = relative[:, :3, 3], (ray_a * ray_b).sum(-1)
        along_a, along_b = (shift * ray_a).sum(-1), (shift * ray_b).sum(-1)
        found = np.stack([cosine * along_b - along_a, along_b - cosine * along_a], axis=-1)
        return found / np.maximum(1 - cosine**2, SHORTEST)[:, None]


@dataclass(frozen=True)
class RoadResiduals(Residuals):
    """The distance of road points from where they would be on a flat road.

    Attributes:
        weights: (N, 2, 3) from an error of a ray in the second image to pixels of the first one, less where the image
            shows no contrast along an axis.
        beside_m: (N,) distance of the points from the way of the vehicle.
    """

    weights: Array
    beside_m: Array

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
