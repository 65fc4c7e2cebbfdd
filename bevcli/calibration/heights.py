"""The heights of the cameras, roughly: the height at which the road looks most alike in both frames of a pair."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from bevcli.calibration.road import beside_way, sampled
from bevcli.calibration.unknowns import GroupGeometry, Unknowns, geometry_at
from bevcli.calibration.views import THREADS, Views
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array

FAR_M, STEP_M = 0.6, 0.03  # of the corrections that are tried
DISTANCES, ANGLES_DEG = np.linspace(2.0, 8.0, 60), np.linspace(-35, 35, 100)  # of road points; in heights of the camera
TILES, POINTS = (6, 10), (10, 10)  # of the road: each has a level of its own, such as that of the pavement
LEAST_CORRELATION = 0.6
LEAST_SHARPNESS, LEAST_SCORE = 0.2, 0.6  # of a peak of the scores, as shares of the sharpest and the highest one's
LANE_M = 4.0  # farther beside the vehicle's way a tile counts less


def search_heights(
    views: Views, unknowns: Unknowns, x: Array, cameras: NDArray[np.bool_] | None = None, reach_m: float = FAR_M
) -> Array:
    """(C,) corrections of the heights in x (P,), at most `reach_m` metres; 0 for cameras outside a mask (C,)."""
    corrections = np.arange(-reach_m, reach_m + STEP_M / 2, STEP_M)
    found = np.zeros(unknowns.cameras)
    searched = np.arange(len(found)) if cameras is None else np.flatnonzero(cameras)
    with ThreadPoolExecutor(THREADS) as threads:
        found[searched] = list(threads.map(lambda c: _best(views, unknowns, x, c, corrections), searched))
    return found


def _best(views: Views, unknowns: Unknowns, x: Array, index: int, corrections: Array) -> float:
    """The correction of a camera among some (H,), by all its pairs of images."""
    groups = [group for group in unknowns.within_camera if unknowns.groups[group, 1] == index]
    found, scores = geometry_at(unknowns, x), np.zeros(len(corrections))
    for group in groups:
        scores += _scores(views, unknowns, found, int(group), corrections)
    return float(corrections[_lowest_level(scores)]) if scores.any() else 0.0


def _lowest_level(scores: Array) -> int:
    """The place of the lowest surface, the road, among the peaks of scores (H,): pavements lie above it."""
    sharpness = np.full(len(scores), -np.inf)
    sharpness[2:-2] = scores[2:-2] - (scores[:-4] + scores[4:]) / 2
    peak = np.r_[False, (scores[1:-1] >= scores[:-2]) & (scores[1:-1] >= scores[2:]), False]
    peak &= scores >= LEAST_SCORE * scores.max()
    sharp = np.where(peak, sharpness, -np.inf)
    if not sharp.max() > 0:
        return int(scores.argmax())
    return int(np.flatnonzero(sharp >= LEAST_SHARPNESS * sharp.max())[-1])


def _scores(views: Views, unknowns: Unknowns, found: GroupGeometry, group: int, corrections: Array) -> Array:
    """The score of each correction (H,) in a pair of images: tiles of the road that look alike vote for it."""
    pair, index, _ = (int(each) for each in unknowns.groups[group])
    camera = views.rig.cameras[index]
    images = [view.texture for view in views.sides((pair, index, index))]
    pose, motion = found.ego_from_camera_a[group], found.ego_b_from_ego_a[group]
    points = _grid(pose)
    moved = points @ motion[:3, :3].T + motion[:3, 3]
    alike = []
    for height in corrections:
        at = pose[:3, 3] + [0, 0, height]
        first, second = (
            _seen(camera, image, (each - at) @ pose[:3, :3])
            for image, each in zip(images, (points, moved), strict=True)
        )
        alike.append(_correlation(first, second))
    correlations = np.stack(alike)  # (H, tiles)
    near = np.exp(
        -((_tiles(beside_way(points.reshape(-1, 3), motion).reshape(points.shape[:2])).mean(-1) / LANE_M) ** 2)
    )
    votes = -np.log(1.001 - correlations) * near
    return np.asarray(votes[:, correlations.max(0) > LEAST_CORRELATION].sum(-1))


def _grid(pose: Array) -> Array:
    """(60, 100, 3) points of the road in front of a camera, in the ego frame."""
    yaw = np.arctan2(pose[1, 2], pose[0, 2])
    angle, distance = np.meshgrid(yaw + np.radians(ANGLES_DEG), DISTANCES * pose[2, 3])
    x, y = pose[0, 3] + distance * np.cos(angle), pose[1, 3] + distance * np.sin(angle)
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def _seen(camera: Camera, image: NDArray[np.uint8], points_camera: Array) -> Array:
    """(tiles, 100) grey values of points (60, 100, 3) in the camera frame; NaN outside of the image."""
    pixels, depth = camera.project(points_camera)
    inside = camera.contains(pixels, depth)
    grey = sampled(image, np.where(inside[..., None], pixels, 0)).astype(np.float64)
    return _tiles(np.where(inside, grey, np.nan))


def _tiles(values: Array) -> Array:
    """Values (60, 100) of the grid -> (tiles, 100)."""
    (rows, columns), (height, width) = TILES, POINTS
    return values.reshape(rows, height, columns, width).swapaxes(1, 2).reshape(rows * columns, height * width)


def _correlation(first: Array, second: Array) -> Array:
    """(tiles,) normalised cross-correlation of tiles (tiles, n); 0 where one of them is not seen whole."""
    a, b = (each - each.mean(-1, keepdims=True) for each in (first, second))
    spread = np.sqrt((a**2).sum(-1) * (b**2).sum(-1))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.nan_to_num((a * b).sum(-1) / spread, nan=0.0, posinf=0.0, neginf=0.0)
