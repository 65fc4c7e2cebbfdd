"""Residuals of road points that two cameras, or one, see from above at two times."""

from dataclasses import dataclass

import numpy as np

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array
from bevcli.workshop.correspondence.residuals import GroupGeometry, Residuals, rays_of_road_points
from bevcli.workshop.odometry.above import RoadFlow

PIXEL = 0.5  # standard deviation of a direction, pixels
FLOW_M = 0.01  # of the flow


@dataclass(frozen=True)
class GroundResiduals(Residuals):
    """The distance of road points from where they would be on a plane road, in standard deviations.

    The weights turn an error of a ray in the second image into metres on the road, divided by their deviation.
    """

    weights: Array  # (N, 2, 3)

    def of(self, geometry: GroupGeometry) -> Array:
        """(N, 2)."""
        ahead = rays_of_road_points(geometry, geometry.ego_from_camera_b, self.group, self.rays_a)
        return np.einsum("nij,nj->ni", self.weights, ahead - self.rays_b)


def rays_and_weights(
    flow: RoadFlow, cameras: tuple[tuple[Camera, ...], tuple[Camera, ...]], yaw: float
) -> tuple[Array, Array, Array]:
    """Rays (n, 3) of the points in the first and in the second images, and the weights (n, 2, 3).

    cameras: of the first and of the second frame. yaw: by which the vehicle turned.
    """
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    (rays_a, spread_a, _), (rays_b, spread_b, to_road) = (
        _seen(points, np.array([camera.ego_from_camera for camera in of])[index],
              np.array([camera.intrinsics[0, 0] for camera in of])[index])
        for points, of, index in zip((flow.first, flow.second), cameras, flow.cameras.T, strict=True)
    )  # fmt: skip
    covariance = spread_a + turn @ spread_b @ turn.T + FLOW_M**2 * np.eye(2)
    size, axes = np.linalg.eigh(covariance)
    whitening = np.einsum("nij,nj,nkj->nik", axes, size**-0.5, axes)
    return rays_a, rays_b, flow.contrast @ whitening @ turn @ to_road


def _seen(points: Array, pose: Array, focal: Array) -> tuple[Array, Array, Array]:
    """How cameras with poses (n, 4, 4) and focal lengths (n,) see points (n, 3) of the road.

    Returns rays (n, 3) in the camera frame, the covariance (n, 2, 2) of a point by the error of a pixel, metres², and
    the derivative (n, 2, 3) of the point by the ray.
    """
    away = points - pose[:, :3, 3]
    length = np.linalg.norm(away, axis=-1, keepdims=True)
    direction = away / length
    slope = np.zeros((len(points), 2, 3))
    slope[:, 0, 0] = slope[:, 1, 1] = 1
    slope[:, :, 2] = -direction[:, :2] / direction[:, 2:]
    slope *= length[:, :, None]
    covariance = (PIXEL / focal)[:, None, None] ** 2 * slope @ slope.swapaxes(1, 2)
    return np.einsum("nji,nj->ni", pose[:, :3, :3], direction), covariance, slope @ pose[:, :3, :3]
