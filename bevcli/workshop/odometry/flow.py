"""Points of the road in two road pictures by optical flow, near the motion that the votes tell, and their residuals."""

from dataclasses import dataclass

import cv2
import numpy as np

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array
from bevcli.workshop.correspondence.residuals import GroupGeometry, Indices, Residuals, rays_of_road_points
from bevcli.workshop.correspondence.road import contrast, flow_at
from bevcli.workshop.odometry.step_views import BEGIN_M, CELL_M, SHAPE, RoadPicture, moved_picture

SPACING, WINDOW = 8, 21  # cells: between points of the flow, and the side of what is compared
PIXEL = 0.5  # standard deviation of a direction, pixels
FLOW_M = 0.01  # of the flow


@dataclass(frozen=True)
class RoadFlow:
    """Points of the road in two pictures."""

    first: Array  # (n, 3) in the first ego frame, metres
    second: Array  # (n, 3) in the second one
    contrast: Array  # (n, 2, 2) symmetric: 0 to 1 along each axis of the contrast, in the first ego frame
    cameras: Indices  # (n, 2) that see them


def road_flow(first: RoadPicture, second: RoadPicture, yaw: float, shift: Array, most_m: float) -> RoadFlow:
    """Points of the road, at most `most_m` from where a motion puts them: a yaw and a shift (2,), ego_a_from_ego_b."""
    c, s = np.cos(yaw), np.sin(yaw)
    back = np.array([[c, s], [-s, c]])  # from the first frame to the second one, about the shift
    warped = moved_picture(second, -yaw, -back @ shift)
    both = cv2.erode((first.seen & warped.seen).astype(np.uint8), np.ones((WINDOW, WINDOW)))
    at = np.argwhere(both[::SPACING, ::SPACING] > 0)[:, ::-1].astype(np.float32) * SPACING
    if not len(at):
        return RoadFlow(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2, 2)), np.zeros((0, 2), dtype=np.int64))
    flow, kept = flow_at(first.texture, warped.texture, at)
    kept &= np.linalg.norm(flow, axis=-1) * CELL_M < most_m
    at, flow = at[kept], flow[kept]
    points, moved = BEGIN_M + CELL_M * at, BEGIN_M + CELL_M * (at + flow)
    there = (moved - shift) @ back.T
    columns, rows = np.rint((there - BEGIN_M) / CELL_M).astype(int).T
    cameras = [first.of[at[:, 1].astype(int), at[:, 0].astype(int)],
               second.of[rows.clip(0, SHAPE[0] - 1), columns.clip(0, SHAPE[1] - 1)]]  # fmt: skip
    seen = np.minimum(*cameras) >= 0
    told = contrast(first.texture, at)
    points, there = (np.column_stack([xy, xy @ of.slopes]) for xy, of in ((points, first), (there, second)))
    return RoadFlow(points[seen], there[seen], told[seen], np.stack(cameras, -1)[seen].astype(np.int64))


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
