"""Residuals: how far matched points, and points of the road, are from where a geometry puts them."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Self

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
