"""The road in both frames of a pair: heights of the cameras, roughly, and points; and cameras on a pavement.

First the height is searched at which the road looks most alike in both frames. Then the second image is warped onto the
first as a flat road would be seen. What is left between the two images is measured by optical flow. It tells the height
of a camera, and its pitch and roll over the road.

A camera may have measured its height from a pavement, which is higher by a kerb. Points that one camera sees in the
first frame of a pair and its neighbour in the second tell their heights above each other. Where these contradict the
road, one of the cameras sees another surface.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from bevcli.geometry.cameras import OUTSIDE, Camera
from bevcli.geometry.transforms import Array
from bevcli.workshop.calibration.adjustment import (
    HEIGHT,
    OF_CAMERA,
    EpipolarResiduals,
    GroupGeometry,
    Indices,
    RoadResiduals,
    Unknowns,
    geometry_at,
    rays_of_road_points,
    values,
)
from bevcli.workshop.calibration.views import THREADS, Views

NEAREST, FARTHEST = 1.3, 9.0  # road points, from the camera, in heights of the camera
WIDEST_M = 10.0  # from the way of the vehicle: farther aside are pavements
STRIDE = 8  # pixels between the points at which the warping is computed; between them it is interpolated
SPACING = 16  # pixels between the points whose flow is measured
WINDOW = 21  # pixels
MOST_BACK_PX = 0.5  # between a point and the flow there and back
FEWEST = 12  # points of a pair of images; fewer are not used
FULL_CONTRAST = 30.0  # mean squared gradient per pixel of a window, grey levels², from which a point counts fully
AXES = np.eye(2)
# For heights:
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
    heights = np.zeros(unknowns.cameras)
    searched = np.arange(len(heights)) if cameras is None else np.flatnonzero(cameras)
    with ThreadPoolExecutor(THREADS) as threads:
        heights[searched] = list(threads.map(lambda c: _best(views, unknowns, x, c, corrections), searched))
    return heights


def _best(views: Views, unknowns: Unknowns, x: Array, index: int, corrections: Array) -> float:
    """The correction of a camera among some (H,), by all its pairs of images."""
    groups = [group for group in unknowns.within_camera if unknowns.groups[group, 1] == index]
    geometry, scores = geometry_at(unknowns, x), np.zeros(len(corrections))
    for group in groups:
        scores += _scores(views, unknowns, geometry, int(group), corrections)
    return float(corrections[_lowest_level(scores)]) if scores.any() else 0.0


def _lowest_level(scores: Array) -> int:
    """The index of the lowest surface, the road, among the peaks of scores (H,): pavements lie above it."""
    sharpness = np.full(len(scores), -np.inf)
    sharpness[2:-2] = scores[2:-2] - (scores[:-4] + scores[4:]) / 2
    peak = np.r_[False, (scores[1:-1] >= scores[:-2]) & (scores[1:-1] >= scores[2:]), False]
    peak &= scores >= LEAST_SCORE * scores.max()
    sharp = np.where(peak, sharpness, -np.inf)
    if not sharp.max() > 0:
        return int(scores.argmax())
    return int(np.flatnonzero(sharp >= LEAST_SHARPNESS * sharp.max())[-1])


def _scores(views: Views, unknowns: Unknowns, geometry: GroupGeometry, group: int, corrections: Array) -> Array:
    """The score of each correction (H,) in a pair of images: tiles of the road that look alike vote for it."""
    pair, index, _ = (int(index) for index in unknowns.groups[group])
    camera = views.rig.cameras[index]
    images = [view.texture for view in views.sides((pair, index, index))]
    pose, motion = geometry.ego_from_camera_a[group], geometry.ego_b_from_ego_a[group]
    points = _grid(pose)
    moved = points @ motion[:3, :3].T + motion[:3, 3]
    alike = []
    for height in corrections:
        at = pose[:3, 3] + [0, 0, height]
        first, second = (
            _seen(camera, image, (seen - at) @ pose[:3, :3])
            for image, seen in zip(images, (points, moved), strict=True)
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
    (rows, columns), (height, width) = TILES, POINTS
    return values.reshape(rows, height, columns, width).swapaxes(1, 2).reshape(rows * columns, height * width)


def _correlation(first: Array, second: Array) -> Array:
    """(tiles,) normalised cross-correlation of tiles (tiles, n); 0 where one of them is not seen whole."""
    a, b = (tiles - tiles.mean(-1, keepdims=True) for tiles in (first, second))
    spread = np.sqrt((a**2).sum(-1) * (b**2).sum(-1))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.nan_to_num((a * b).sum(-1) / spread, nan=0.0, posinf=0.0, neginf=0.0)


def road_residuals(views: Views, unknowns: Unknowns, x: Array, most_px: float) -> RoadResiduals:
    """Road points of all groups, at most `most_px` pixels from where the unknowns x (P,) expect them."""
    groups, geometry = unknowns.within_camera, geometry_at(unknowns, x)
    with ThreadPoolExecutor(THREADS) as threads:
        parts = list(threads.map(lambda group: _points_of(views, unknowns, geometry, int(group), most_px), groups))
    counts = [len(part[0]) for part in parts]
    columns = (np.concatenate([part[side] for part in parts]) for side in range(4))
    return RoadResiduals(np.repeat(groups, counts), *columns)


def _points_of(
    views: Views, unknowns: Unknowns, geometry: GroupGeometry, group: int, most_px: float
) -> tuple[Array, Array, Array, Array]:
    """The fields of `RoadResiduals` after the first for the points of a group."""
    nothing = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2, 3)), np.zeros(0)
    pair, index, _ = (int(index) for index in unknowns.groups[group])
    camera = views.rig.cameras[index]
    first, second = (view.texture for view in views.sides((pair, index, index)))
    warp = _warp(camera, geometry, group)
    if warp is None:
        return nothing
    field, road = warp
    warped = sampled(second, field)
    inside = cv2.erode(road.astype(np.uint8), np.ones((WINDOW, WINDOW)))
    at = np.argwhere(inside[::SPACING, ::SPACING] > 0)[:, ::-1].astype(np.float32) * SPACING
    if len(at) < FEWEST:
        return nothing
    flow, kept = _flow(first, warped, at)
    kept &= np.linalg.norm(flow, axis=-1) < most_px
    at, flow = at[kept], flow[kept]
    if len(at) < FEWEST:
        return nothing
    target = _sample(field, at + flow)
    rays_a, rays_b = camera.rays(at), camera.rays(target)
    beside = beside_way(points_of_road(geometry.ego_from_camera_a[group], rays_a), geometry.ego_b_from_ego_a[group])
    return rays_a, rays_b, _weights(camera, first, field, at, target), beside


def _warp(camera: Camera, geometry: GroupGeometry, group: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]] | None:
    """The map from the first image of a group to the second, over a flat road; None where they share no road.

    Returns (h, w, 2) pixels in the second image, far outside where there is no road to compare, and (h, w) the pixels
    of the first image with road.
    """
    columns, rows = np.arange(0, camera.width + STRIDE, STRIDE), np.arange(0, camera.height + STRIDE, STRIDE)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).astype(np.float64)
    rays = camera.rays(pixels.reshape(-1, 2))
    pose, motion = geometry.ego_from_camera_a[group], geometry.ego_b_from_ego_a[group]
    points = points_of_road(pose, rays)
    away = np.linalg.norm((points - pose[:3, 3])[:, :2], axis=-1)
    road = (away > NEAREST * pose[2, 3]) & (away < FARTHEST * pose[2, 3]) & (beside_way(points, motion) < WIDEST_M)
    ahead = rays_of_road_points(geometry, np.full(len(rays), group), np.nan_to_num(rays, nan=-1.0))
    target, in_front = camera.project(ahead)
    road &= camera.contains(target, in_front)
    shape = pixels.shape[:2]
    if road.sum() < 4:
        return None
    near = np.nan_to_num(target, nan=OUTSIDE).reshape(*shape, 2).astype(np.float32)
    size = (columns[-1] + STRIDE, rows[-1] + STRIDE)
    matrix = np.array([[1 / STRIDE, 0, 0], [0, 1 / STRIDE, 0]])
    whole, inside = (
        cv2.warpAffine(coarse, matrix, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        for coarse in (near, road.reshape(shape).astype(np.float32))
    )
    cut = np.s_[: camera.height, : camera.width]
    return np.ascontiguousarray(whole[cut]), inside[cut] > 0.999


def points_of_road(pose: Array, rays: Array) -> Array:
    """Points (n, 3) of the plane z = 0 that rays (n, 3) of a camera with a pose (4, 4) hit; NaN above the horizon."""
    directions = rays @ pose[:3, :3].T
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = np.where(directions[:, 2] < -1e-3, pose[2, 3] / -directions[:, 2], np.nan)
    return np.asarray(pose[:3, 3] + depth[:, None] * directions)


def beside_way(points: Array, motion: Array) -> Array:
    """(n,) distance of points (n, 3) of the ego frame from the way of the vehicle, an arc through both positions."""
    ahead = np.linalg.inv(motion)[:2, 3]
    if np.hypot(*ahead) < 1e-6:
        return np.abs(points[:, 1])
    bend = 2 * ahead[1] / (ahead @ ahead)  # of the circle that is tangent to x
    if abs(bend) < 1e-4:
        return np.abs(points[:, 1])
    return np.abs(np.hypot(points[:, 0], points[:, 1] - 1 / bend) - abs(1 / bend))


def _flow(
    first: NDArray[np.uint8], warped: NDArray[np.uint8], at: NDArray[np.float32]
) -> tuple[Array, NDArray[np.bool_]]:
    """The flow (n, 2) from the first image at points (n, 2), and whether it is believed."""
    start, size, levels = at[:, None], (WINDOW, WINDOW), 2
    there, tracked, _ = cv2.calcOpticalFlowPyrLK(first, warped, start, start.copy(), winSize=size, maxLevel=levels)
    back, again, _ = cv2.calcOpticalFlowPyrLK(warped, first, there, start.copy(), winSize=size, maxLevel=levels)
    returned = np.linalg.norm((back - start)[:, 0], axis=-1) < MOST_BACK_PX
    flow = np.asarray(there - start, dtype=np.float64)[:, 0]
    return flow, (tracked.ravel() > 0) & (again.ravel() > 0) & returned


def sampled(image: NDArray[Any], pixels: NDArray[Any]) -> NDArray[Any]:
    """Values (h, w) or (h, w, D) of an image or a field at pixels (h, w, 2)."""
    x, y = (np.ascontiguousarray(pixels[..., axis], dtype=np.float32) for axis in (0, 1))
    return cv2.remap(image, x, y, cv2.INTER_LINEAR)


def _sample(field: NDArray[np.float32], at: NDArray[Any]) -> Array:
    """Values (n, 2) of a field (h, w, 2) at pixels (n, 2)."""
    return sampled(field, at[:, None])[:, 0].astype(np.float64)


def _weights(
    camera: Camera, first: NDArray[np.uint8], field: NDArray[np.float32], at: NDArray[Any], target: Array
) -> Array:
    """(n, 2, 3) from an error of a ray in the second image to pixels of the first, weighted by the contrast there."""
    stretch = np.stack([_sample(field, at + 2 * axis) - _sample(field, at - 2 * axis) for axis in AXES], -1) / 4
    back = np.linalg.pinv(np.nan_to_num(stretch))  # (n, 2, 2), pixels of the first image by those of the second
    along = np.stack([(camera.rays(target + axis) - camera.rays(target - axis)) / 2 for axis in AXES], -1)
    across = np.linalg.pinv(np.nan_to_num(along))  # (n, 2, 3), pixels of the second image by its rays
    return _contrast(first, at) @ back @ across


def _contrast(image: NDArray[np.uint8], at: NDArray[Any]) -> Array:
    """(n, 2, 2) symmetric, 0 to 1 along each axis of the contrast around pixels (n, 2)."""
    dx, dy = (cv2.Sobel(image, cv2.CV_32F, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1)))
    products = np.stack([dx * dx, dx * dy, dy * dy], axis=-1)
    mean = cv2.boxFilter(products, -1, (WINDOW, WINDOW))
    columns, rows = np.rint(at).astype(int).T
    xx, xy, yy = mean[rows, columns].astype(np.float64).T
    size, axes = np.linalg.eigh(np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2))
    share = np.sqrt(np.clip(size / FULL_CONTRAST, 0, 1))
    return np.einsum("nij,nj,nkj->nik", axes, share, axes)


STARTS_M = np.arange(-0.45, 0.46, 0.15)  # of a camera's height, about the present one
LEAST_STEP_M = 0.08  # smaller steps are no kerb
MOST_PX = 60.0  # residual of a point that may fit after a step
SCALES_PX = (6.0, 3.0, 1.5, 1.0, 1.0)  # of Cauchy's loss, step by step
ROAD_FITS_PX, FITS_PX = 1.0, 0.5  # of points of the road; of shared points
NEAREST_M = 1.0  # distance of a shared point; wrong matches are behind the cameras as often as before them
LEAST_GAIN, LEAST_SHARE = 10, 0.3  # points that fit after a step and did not before: number, and share of those before
WAY_M, FEWEST_ON_WAY = 2.0, 60  # distance from the vehicle's way that is road for sure; points there
FEWEST_TIES, LEAST_TIED = 30, 0.12  # shared points that fit: number, and share of those before both cameras
MOST_DEVIATIONS = 3.0  # of the stated position
POSITION = np.arange(HEIGHT - 2, HEIGHT + 1)  # among the unknowns of a camera
DIFFERENCE_M = 1e-5  # for derivatives


def level_corrections(unknowns: Unknowns, road: RoadResiduals, ties: EpipolarResiduals, x: Array) -> Array:
    """(P,) corrections of x (P,): of the positions of cameras on another level than their neighbours; 0 for most.

    Cameras that see the road stay. ties: points that two cameras share.
    """
    corrected, stays = x.copy(), sees_road(unknowns, road, ties, x)
    ties = ties.where(np.abs(values(unknowns, ties, x)[:, 0]) < MOST_PX)
    # Two neighbours may see the same pavement; then only both together contradict the others.
    pairs = np.unique(np.sort(unknowns.groups[ties.group, 1:], axis=-1), axis=0)
    sets = [cameras for cameras in (*np.arange(unknowns.cameras)[:, None], *pairs) if not stays[cameras].any()]
    for _ in sets:  # the largest contradiction first: it may be the cause of others
        gain, best = max(
            (_best_level(unknowns, ties, corrected, cameras) for cameras in sets), key=lambda gain_and_x: gain_and_x[0]
        )
        if gain <= 0:
            break
        corrected = best
    return corrected - x


def sees_road(unknowns: Unknowns, road: RoadResiduals, ties: EpipolarResiduals, x: Array) -> NDArray[np.bool_]:
    """(C,) the cameras that have measured their height from the road, and not from a pavement.

    They are the camera that sees most of the road right where the vehicle drives, those with which enough of the shared
    points fit, and so on; then the camera that sees most of it among those that nothing ties to these.
    """
    # A wrong height in a turn moves a camera sideways.
    moves, most = unknowns.of_camera(x), MOST_DEVIATIONS * unknowns.of_camera(unknowns.deviations)
    possible = np.asarray((np.abs(moves) <= most)[:, POSITION].all(-1))
    on_way = _on_way(unknowns, road, x) * possible
    before, fits = (_shared(unknowns, ties.where(which(unknowns, ties, x))) for which in (_before_both, _fits))
    agree = fits >= np.maximum(FEWEST_TIES, LEAST_TIED * before)
    _, alike = connected_components(agree, directed=False)
    seen = np.zeros(unknowns.cameras, dtype=bool)
    while True:
        untied = np.array([before[alike == group][:, seen].sum() < FEWEST_TIES for group in alike])
        first = np.where(untied & ~seen, on_way, 0)
        if first.max() < FEWEST_ON_WAY:
            return seen
        seen[first.argmax()] = True
        _add_tied(seen, possible, before, fits)


def _add_tied(seen: NDArray[np.bool_], possible: NDArray[np.bool_], before: Indices, fits: Indices) -> None:
    """Add, in place, the possible cameras with which enough points fit that they share with those seen, best first."""
    for _ in seen:
        shared, fitting = before[:, seen].sum(-1), fits[:, seen].sum(-1)
        share = np.where((fitting >= FEWEST_TIES) & possible & ~seen, fitting / np.maximum(shared, 1), 0)
        if share.max() < LEAST_TIED:
            break
        seen[share.argmax()] = True


def _shared(unknowns: Unknowns, ties: EpipolarResiduals) -> NDArray[np.int64]:
    """(C, C) the number of points that two cameras share."""
    counts = np.zeros((unknowns.cameras, unknowns.cameras), dtype=np.int64)
    first, second = unknowns.groups[ties.group, 1:].T
    np.add.at(counts, (first, second), 1)
    return counts + counts.T


def _on_way(unknowns: Unknowns, road: RoadResiduals, x: Array) -> NDArray[np.int64]:
    """(C,) how many points of the road a camera sees right where the vehicle drives."""
    fits = np.linalg.norm(values(unknowns, road, x), axis=-1) < ROAD_FITS_PX
    on_way = unknowns.groups[road.group[fits & (road.beside_m < WAY_M)], 1]
    return np.bincount(on_way, minlength=unknowns.cameras)


def _best_level(unknowns: Unknowns, ties: EpipolarResiduals, x: Array, cameras: Indices) -> tuple[float, Array]:
    """How many more points fit with some cameras on another level, beyond what chance may do; and x with them there."""
    mine = ties.where(np.asarray(np.isin(unknowns.groups[ties.group, 1:], cameras).any(-1)))
    columns = (OF_CAMERA * cameras[:, None] + POSITION).ravel()
    heights = OF_CAMERA * cameras + HEIGHT
    before = _fits(unknowns, mine, x).sum()
    best, gain = x, 0.0
    for start in STARTS_M:
        moved = x.copy()
        moved[heights] += start
        moved = _positioned(unknowns, mine, moved, columns)
        more = _fits(unknowns, mine, moved).sum() - (1 + LEAST_SHARE) * before - LEAST_GAIN
        if more > gain and np.abs(moved[heights] - x[heights]).min() >= LEAST_STEP_M:
            best, gain = moved, more
    return gain, best


def _fits(unknowns: Unknowns, ties: EpipolarResiduals, x: Array) -> NDArray[np.bool_]:
    """(N,) whether shared points are where both cameras see them."""
    return _before_both(unknowns, ties, x) & (np.abs(values(unknowns, ties, x)[:, 0]) < FITS_PX)


def _before_both(unknowns: Unknowns, ties: EpipolarResiduals, x: Array) -> NDArray[np.bool_]:
    return np.asarray((ties.depths(geometry_at(unknowns, x)) > NEAREST_M).all(-1))


def _positioned(unknowns: Unknowns, ties: EpipolarResiduals, x: Array, columns: Indices) -> Array:
    """x with the positions of cameras, the unknowns at `columns`, where the points that they share fit best."""
    x, prior = x.copy(), np.diag(1 / unknowns.deviations[columns] ** 2)
    if not len(ties.group):
        return x
    for scale in SCALES_PX:
        here = values(unknowns, ties, x)[:, 0]
        steps = [x + DIFFERENCE_M * (np.arange(len(x)) == column) for column in columns]
        slopes = np.stack([(values(unknowns, ties, step)[:, 0] - here) / DIFFERENCE_M for step in steps], axis=-1)
        weighted = slopes / (scale**2 + here**2)[:, None]
        x[columns] -= np.linalg.solve(weighted.T @ slopes + prior, weighted.T @ here + prior @ x[columns])
    return x
