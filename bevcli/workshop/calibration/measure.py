"""The measurement: rotations from matched points, heights from the road, and rounds of both together.

Points are matched by SIFT features; what moves by itself is left out.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array
from bevcli.workshop.calibration.adjustment import (
    HEIGHT,
    OF_CAMERA,
    OF_PAIR,
    EpipolarResiduals,
    RoadResiduals,
    Solution,
    Term,
    Unknowns,
    solve,
    spread,
    values,
)
from bevcli.workshop.calibration.options import CalibrateOptions
from bevcli.workshop.calibration.road import level_corrections, road_residuals, search_heights, sees_road
from bevcli.workshop.calibration.views import THREADS, View, Views

FEATURES = 2000  # an image
RATIO = 0.75  # of the distances to the best and the second best match
INLIER_PX = 1.5
FEWEST = 15  # matches of a pair of images; fewer are not used
CELLS = (10, 6)  # of an image, across and down;
MOST_IN_CELL = 6  # matches in one of them, so that no object counts for all
FLATTEST = 0.25  # cosine of the largest angle off the optical axis of a matched ray
_Features = tuple[Array, NDArray[np.float32]]  # pixels (F, 2) and descriptors (F, 128)


@dataclass(frozen=True)
class PointMatches(EpipolarResiduals):
    """M matches of all pairs."""

    same: NDArray[np.bool_]  # (M,) whether both images are of the same camera


def match_points(views: Views) -> PointMatches:
    """The matches of all groups of views."""
    groups = views.groups()
    with ThreadPoolExecutor(THREADS) as threads:
        features = dict(zip(views.of, threads.map(_features, views.of.values()), strict=True))

        def matched(group: tuple[int, int, int]) -> tuple[Array, Array]:
            (a, b), (_, first, second) = views.pairs[group[0]], group
            cameras = views.rig.cameras[first], views.rig.cameras[second]
            return _matched(features[a, first], features[b, second], *cameras)

        rays = list(threads.map(matched, groups))
    counts = [len(a) for a, _ in rays]
    rays_a, rays_b = (np.concatenate(side) for side in zip(*rays, strict=True))
    _, first, second = (np.repeat(column, counts) for column in np.array(groups).T)
    group = np.repeat(np.arange(len(counts)), counts)
    focal = np.array([camera.intrinsics[0, 0] for camera in views.rig.cameras])[first]
    return PointMatches(group, rays_a, rays_b, focal, first == second)


def _features(view: View) -> _Features:
    detector = cv2.SIFT.create(nfeatures=FEATURES, enable_precise_upscale=True)
    points, descriptors = detector.detectAndCompute(view.pixels, None)
    if descriptors is None:
        return np.zeros((0, 2)), np.zeros((0, 128), dtype=np.float32)
    return np.array([point.pt for point in points], dtype=np.float64), np.asarray(descriptors, dtype=np.float32)


def _matched(a: _Features, b: _Features, first: Camera, second: Camera) -> tuple[Array, Array]:
    """Rays (m, 3) and (m, 3) of the matches; those within one camera fit one rigid motion."""
    nothing = np.zeros((0, 3)), np.zeros((0, 3))
    if min(len(a[0]), len(b[0])) < FEWEST:
        return nothing
    nearest, quality, other = _nearest(a[1], b[1])
    kept = quality < RATIO**2 * other
    if kept.sum() < FEWEST:
        return nothing
    pixels_a, quality = a[0][kept], quality[kept]
    rays_a, rays_b = first.rays(pixels_a), second.rays(b[0][nearest[kept]])
    with np.errstate(invalid="ignore"):
        good = (rays_a[:, 2] > FLATTEST) & (rays_b[:, 2] > FLATTEST)
    if first is second:
        good[good] = _rigid(rays_a[good], rays_b[good], first)
    chosen = np.flatnonzero(good)
    # SIFT gives a point with several orientations several times.
    chosen = chosen[np.sort(np.unique(pixels_a[chosen].astype(int), axis=0, return_index=True)[1])]
    chosen = chosen[_spread(pixels_a[chosen], quality[chosen].astype(np.float64), first)]
    return rays_a[chosen], rays_b[chosen]


def _nearest(
    a: NDArray[np.float32], b: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
    """The nearest of the descriptors b (F, 128) for each of a (A, 128); squared distances to it and to the next one.

    A matrix product is three times as fast as OpenCV's matcher, and as exact: SIFT's descriptors are whole numbers.
    """
    distances = (b**2).sum(-1) - 2 * (a @ b.T)
    rows, nearest = np.arange(len(a)), distances.argmin(-1)
    best = distances[rows, nearest]
    distances[rows, nearest] = np.inf
    lengths = (a**2).sum(-1)
    return nearest, lengths + best, lengths + distances.min(-1)


def _rigid(rays_a: Array, rays_b: Array, camera: Camera) -> NDArray[np.bool_]:
    """(m,) the matches that one rigid motion explains: all others move by themselves, or are wrong."""
    nothing = np.zeros(len(rays_a), dtype=bool)
    if len(rays_a) < FEWEST:
        return nothing
    flat_a, flat_b = (rays[:, :2] / rays[:, 2:] for rays in (rays_a, rays_b))
    threshold = INLIER_PX / camera.intrinsics[0, 0]
    _, inliers = cv2.findEssentialMat(flat_a, flat_b, np.eye(3), cv2.RANSAC, 0.999, threshold)
    if inliers is None or inliers.sum() < FEWEST:
        return nothing
    return np.asarray(inliers.ravel() > 0)


def _spread(pixels: Array, distance: Array, camera: Camera) -> NDArray[np.int64]:
    cell = (pixels / [camera.width, camera.height] * CELLS).astype(int).clip(0, np.array(CELLS) - 1) @ [1, CELLS[0]]
    order = np.lexsort((distance, cell))
    first = np.searchsorted(cell[order], cell[order])
    return np.sort(order[np.arange(len(order)) - first < MOST_IN_CELL])


SCALES_PX = (20.0, 5.0, 1.5, 0.7)  # of Cauchy's loss for points, one search after the other
POINT_SCALE_PX, ROAD_SCALES_PX = 0.3, (3.0, 1.0, 0.5)  # then: the smallest one, and those of road points
CONSISTENT_PX, CONSISTENT_SHARE = 5.0, 0.5  # of the points of a pair of images: residual, and share of all
TURN_ROUNDS = 4  # in which the error of the vehicle's rotation is estimated
SMALLEST_TURN = np.radians(0.005)  # of it
KERB_M = 0.09  # less than from the road to a pavement
FLOWS_PX = (12.0, 8.0)  # largest distance of road points from where they are expected, round by round
PARTS = 2 + 2 * len(FLOWS_PX)  # of the work, for progress


@dataclass(frozen=True)
class Measurement:
    """What the drive says about the unknowns."""

    views: Views
    matches: PointMatches  # of all pairs
    unknowns: Unknowns
    solution: Solution
    points: PointMatches  # the matches that were used
    road: RoadResiduals


def measure(
    views: Views, matches: PointMatches, options: CalibrateOptions, progress: Callable[[], None] = lambda: None
) -> Measurement:
    """Measure all unknowns. progress: called PARTS times."""
    unknowns = Unknowns.of(views, options)
    within, x = matches.where(matches.same), np.zeros(len(unknowns.deviations))
    for scale in SCALES_PX:
        x = solve(unknowns, [(within, scale)], x).x
    within = consistent(unknowns, within, x)
    progress()
    heights = np.arange(unknowns.cameras) * OF_CAMERA + HEIGHT
    x[heights] += search_heights(views, unknowns, x)
    progress()
    ties = matches.where(~matches.same)
    for most_px in FLOWS_PX:
        road = road_residuals(views, unknowns, x, most_px)
        progress()
        for scale in ROAD_SCALES_PX:
            x = solve(unknowns, _terms(unknowns, within, road, x, scale), x).x
        if most_px == FLOWS_PX[0]:
            levels = level_corrections(unknowns, road, ties, x)
            x = x + levels
            # Shared points tell the level, and the road then tells the height to the step of the search.
            x[heights] += search_heights(views, unknowns, x, levels[heights] != 0, KERB_M)
        progress()
    road = road.where(sees_road(unknowns, road, ties, x)[unknowns.groups[road.group, 1]])
    for _ in range(TURN_ROUNDS):
        solution = solve(unknowns, _terms(unknowns, within, road, x, ROAD_SCALES_PX[-1]), x)
        x, unknowns = solution.x, with_estimated_turns(unknowns, solution)
    return Measurement(views, matches, unknowns, solution, within, road)


def _terms(unknowns: Unknowns, points: PointMatches, road: RoadResiduals, x: Array, road_scale: float) -> list[Term]:
    """Both kinds of residuals, with the spread that they have at x (P,)."""
    scales = ((points, POINT_SCALE_PX), (road, road_scale))
    return [(residuals, np.maximum(least, spread(unknowns, residuals, x))) for residuals, least in scales]


def consistent(unknowns: Unknowns, points: PointMatches, x: Array) -> PointMatches:
    """The points that fit at x (P,), of the image pairs in which most of them do.

    Repeated texture gives pairs whose matches fit a motion, but not that of the vehicle.
    """
    fits = np.abs(values(unknowns, points, x)[:, 0]) < CONSISTENT_PX
    count = len(unknowns.groups)
    fitting, matched = (np.bincount(group, minlength=count) for group in (points.group[fits], points.group))
    shares = fitting / np.maximum(matched, 1)
    return points.where(fits & (shares[points.group] >= CONSISTENT_SHARE))


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
