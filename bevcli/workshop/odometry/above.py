"""The road of a frame seen from above, how the vehicle drove between two such pictures, and residuals of its points.

Tiles of the first picture are compared with the second one at all distances along the way; those that look alike vote.
Near the motion that they tell, optical flow gives points of the road.
"""

from collections.abc import Sequence as Items
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import OUTSIDE, Camera
from bevcli.geometry.transforms import Array
from bevcli.workshop.correspondence.images import GreyImage, texture
from bevcli.workshop.correspondence.residuals import GroupGeometry, Indices, Residuals, rays_of_road_points
from bevcli.workshop.correspondence.road import contrast, flow_at, sampled

CELL_M = 0.08
BEGIN_M, SHAPE = (-24.0, -9.0), (225, 640)  # the smallest x and y; cells along y and x
SLOPE_STEP, KEPT = np.radians(0.25), 3  # of grids
MOST_BLUR_M = 0.45  # of the road in one pixel, along the ray
MARGIN = 9  # cells, between cameras
TILE, ASIDE = 25, 2  # cells: side of a tile, and by how much it may lie beside the way
LEAST_SEEN, LEAST_CONTRAST = 0.8, 8.0  # of a tile: share, and grey levels of standard deviation
NOTHING, MOST = 0.15, 2.0  # of the vote of a tile, less of which is chance, and which is the largest
SPACING, WINDOW = 8, 21  # cells: between points of the flow, and the side of what is compared
WAY_M = 5.0  # tiles farther beside the vehicle count less: they are less often road
PIXEL = 0.5  # standard deviation of a direction, pixels
FLOW_M = 0.01  # of the flow


@dataclass(frozen=True)
class RoadPicture:
    """The road around the vehicle in the ego frame; rows along y, columns along x."""

    texture: NDArray[np.uint8]  # (225, 640), 128 where nothing is seen
    seen: NDArray[np.bool_]  # (225, 640)
    of: NDArray[np.int8]  # (225, 640) the camera of each cell, -1 for none
    slopes: Array  # (2,) of the road along x and y


def nearest_cameras(cameras: Items[Camera], points: Array) -> tuple[list[NDArray[np.float32]], NDArray[np.int8], Array]:
    """The cameras that see points (H, W, 3) of the road sharply, ego frame.

    Returns the pixels (H, W, 2) of the points in each camera; the index (H, W) of the nearest one that sees them, -1
    where none does; and the distance (H, W) to it.
    """
    maps, distances = [], []
    for camera in cameras:
        pixels, depth = camera.project_ego(points)
        away = np.linalg.norm(points - camera.ego_from_camera[:3, 3], axis=-1)
        blur = away**2 / max(camera.ego_from_camera[2, 3] * camera.intrinsics[0, 0], 1e-3)
        usable = camera.contains(pixels, depth) & (blur < MOST_BLUR_M)
        distances.append(np.where(usable, away, np.inf))
        maps.append(np.nan_to_num(pixels, nan=OUTSIDE).astype(np.float32))
    nearest, distance = np.argmin(distances, axis=0), np.min(distances, axis=0)
    return maps, np.where(np.isinf(distance), -1, nearest).astype(np.int8), distance


class RoadGrid:
    """The cells of a road picture, of a road with slopes (2,) in the ego frame, in the images of a rig."""

    def __init__(self, cameras: Items[Camera], slopes: Array) -> None:
        self._slopes = slopes
        rows, columns = np.indices(SHAPE)
        x, y = BEGIN_M[0] + CELL_M * columns, BEGIN_M[1] + CELL_M * rows
        points = np.stack([x, y, slopes[0] * x + slopes[1] * y], axis=-1)
        self._maps, self._of, _ = nearest_cameras(cameras, points)

    def picture(self, images: Items[GreyImage | None]) -> RoadPicture:
        """The road in the images of a frame."""
        grey, seen = np.zeros(SHAPE, dtype=np.float32), np.zeros(SHAPE, dtype=bool)
        for index, (image, pixels) in enumerate(zip(images, self._maps, strict=True)):
            mine = self._of == index
            if image is None or not mine.any():
                continue
            grey[mine] = sampled(image.pixels, pixels)[mine]
            seen |= cv2.erode(mine.astype(np.uint8), np.ones((MARGIN, MARGIN))) > 0
        return RoadPicture(texture(grey, seen), seen, self._of, self._slopes)


class RoadGrids:
    """The grids of a rig by slopes of the road, in steps of SLOPE_STEP; the last ones are kept."""

    def __init__(self, cameras: Items[Camera]) -> None:
        self._cameras = cameras
        self._grids: dict[tuple[float, float], RoadGrid] = {}

    def at(self, slopes: Array) -> RoadGrid:
        """The grid nearest to slopes (2,)."""
        x, y = (float(round(slope / SLOPE_STEP) * SLOPE_STEP) for slope in slopes)
        grid = self._grids.pop((x, y), None) or RoadGrid(self._cameras, np.array([x, y]))
        self._grids[x, y] = grid
        while len(self._grids) > KEPT:
            del self._grids[next(iter(self._grids))]
        return grid


def distance_votes(
    first: RoadPicture, second: RoadPicture, heading: float, yaw: float, cells: tuple[int, int]
) -> tuple[Array, Array]:
    """Distances (D,) in metres, and the votes (D,) of the tiles of the road for each.

    heading: direction of the way in the first ego frame. yaw: by which the vehicle turned. cells: least and largest
    distance, a negative one is driven backwards.
    """
    turns = (first, heading), (second, heading - yaw)
    a, b = (moved_picture(picture, angle, np.zeros(2)) for picture, angle in turns)  # the way is along x
    shifts = np.arange(cells[0], cells[1] + 1)
    distances = np.asarray(CELL_M * shifts, dtype=np.float64)
    correlations, weights = [], []
    (height, width), last = SHAPE, SHAPE[1] - TILE
    for row in range(ASIDE, height - TILE - ASIDE + 1, TILE):
        strip = np.ascontiguousarray(b.texture[row - ASIDE : row + TILE + ASIDE])
        covered = cv2.boxFilter(b.seen[row : row + TILE].mean(0, dtype=np.float32)[None], -1, (TILE, 1), anchor=(0, 0))
        beside = BEGIN_M[1] + (row + TILE / 2) * CELL_M
        for column in range(0, width - TILE + 1, TILE):
            part = np.s_[row : row + TILE, column : column + TILE]
            if a.seen[part].mean() < LEAST_SEEN or a.texture[part].std() < LEAST_CONTRAST:
                continue
            found = cv2.matchTemplate(strip, np.ascontiguousarray(a.texture[part]), cv2.TM_CCOEFF_NORMED).max(0)
            at = column - shifts
            inside = (at >= 0) & (at <= last)
            usable = inside & (covered[0, at.clip(0, last)] >= LEAST_SEEN)
            correlations.append(np.where(usable, found[at.clip(0, last)], np.nan))
            weights.append(np.exp(-((beside / WAY_M) ** 2)))
    if not correlations:
        return distances, np.zeros(len(shifts))
    return distances, _summed(np.stack(correlations), np.array(weights))


def _summed(correlations: Array, weights: Array) -> Array:
    """(D,) votes of tiles with correlations (tiles, D): what a tile says of a distance beyond what it says of all."""
    seen = np.isfinite(correlations)
    votes = -np.log(1.001 - np.clip(np.nan_to_num(correlations), 0, 1))
    usual = np.array([np.median(vote[mask]) if mask.any() else 0.0 for vote, mask in zip(votes, seen, strict=True)])
    votes = np.where(seen, np.clip(votes - usual[:, None] - NOTHING, 0, MOST), 0)
    return np.asarray((weights[:, None] * votes).sum(0) / np.sqrt(1 + (weights[:, None] * seen).sum(0)))


def moved_picture(picture: RoadPicture, yaw: float, shift: Array) -> RoadPicture:
    """The picture in a frame; its points are turned by a yaw and then shifted (2,) to be those of the picture's."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn, begin = np.array([[c, -s], [s, c]]), np.array(BEGIN_M)
    matrix = np.column_stack([turn, (turn @ begin + shift - begin) / CELL_M])
    size, inverse = SHAPE[::-1], cv2.WARP_INVERSE_MAP
    grey = cv2.warpAffine(picture.texture, matrix, size, flags=inverse | cv2.INTER_LINEAR, borderValue=128)
    seen = cv2.warpAffine(picture.seen.astype(np.uint8), matrix, size, flags=inverse | cv2.INTER_NEAREST)
    return replace(picture, texture=np.asarray(grey, dtype=np.uint8), seen=seen > 0)


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
    points, there = (np.column_stack([each, each @ of.slopes]) for each, of in ((points, first), (there, second)))
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
