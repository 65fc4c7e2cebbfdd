"""The road in both frames of a pair: heights of the cameras, roughly, and points; and cameras on a pavement.

First the height is searched at which the road looks most alike in both frames. Then points of the road are measured by
optical flow. They tell the height of a camera, and its pitch and roll over the road.

A camera may have measured its height from a pavement, which is higher by a kerb. Points that one camera sees in the
first frame of a pair and its neighbour in the second tell their heights above each other. Where these contradict the
road, one of the cameras sees another surface.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from bevcli.geometry.transforms import Array
from bevcli.workshop.calibration.estimates import HEIGHT, OF_CAMERA, Unknowns
from bevcli.workshop.calibration.views import Views
from bevcli.workshop.correspondence.images import (
    THREADS,
    RoadPoints,
    beside_way,
    correlation,
    grey_tiles,
    grid_ahead,
    road_points,
    tiles,
    votes,
)
from bevcli.workshop.correspondence.residuals import (
    SHORTEST,
    EpipolarResiduals,
    GroupGeometry,
    Indices,
    RoadResiduals,
    geometry_at,
    values,
)

FAR_M, STEP_M = 0.6, 0.03  # of the corrections that are tried
LEAST_CORRELATION = 0.6
LEAST_SHARPNESS, LEAST_SCORE = 0.2, 0.6  # of a peak of the scores, as shares of the sharpest and the highest one's
BESIDE_M = 4.0  # farther beside the vehicle's way a tile counts less
LANE_M = 3.0  # from the vehicle's way
TURNED, EVERY, ROLL = np.radians(1.0), 3, 2  # of cameras, to see if the road shows it; pairs; index of roll of a camera


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
    points = grid_ahead(pose)
    moved = points @ motion[:3, :3].T + motion[:3, 3]
    alike = []
    for height in corrections:
        at = pose[:3, 3] + [0, 0, height]
        first, second = (
            grey_tiles(camera, image, (seen - at) @ pose[:3, :3])
            for image, seen in zip(images, (points, moved), strict=True)
        )
        alike.append(correlation(first, second))
    correlations = np.stack(alike)  # (H, tiles)
    near = np.exp(
        -((tiles(beside_way(points.reshape(-1, 3), motion).reshape(points.shape[:2])).mean(-1) / BESIDE_M) ** 2)
    )
    weighted = votes(correlations) * near
    return np.asarray(weighted[:, correlations.max(0) > LEAST_CORRELATION].sum(-1))


def road_residuals(
    views: Views, unknowns: Unknowns, x: Array, most_px: float, signals: Array, groups: Indices | None = None
) -> RoadResiduals:
    """Road points of all or some groups, at most `most_px` pixels from where the unknowns x (P,) expect them.

    signals: (C,) `least_signal` of `road_points` for each camera. Where it is above 0, only points near the vehicle's
    way count: farther beside are kerbs, grass and parked cars, which look like a road that is tilted.
    """
    indices, geometry = unknowns.within_camera if groups is None else groups, geometry_at(unknowns, x)

    def of_group(group: int) -> RoadPoints:
        pair, index, _ = (int(number) for number in unknowns.groups[group])
        first, second = (view.texture for view in views.sides((pair, index, index)))
        return road_points(views.rig.cameras[index], (first, second), geometry, group, most_px, signals[index])

    with ThreadPoolExecutor(THREADS) as threads:
        parts = list(threads.map(of_group, indices))
    counts = [len(points.rays_a) for points in parts]
    columns = (np.concatenate([getattr(points, field.name) for points in parts]) for field in fields(RoadPoints))
    road = RoadResiduals(np.repeat(indices, counts), *columns)
    return road.where((road.beside_m < LANE_M) | (signals == 0)[unknowns.groups[road.group, 1]])


def followed(views: Views, unknowns: Unknowns, x: Array, most_px: float, signals: Array) -> Array:
    """(C,) how much of a wrong roll of a camera the road shows: 1 for all of it, or for a camera without road.

    Flow along an edge stays where its search begins. Then the road agrees with any calibration, and small residuals say
    nothing. So the road is measured with cameras that are turned to the left and to the right by TURNED.
    """
    groups = unknowns.within_camera[unknowns.groups[unknowns.within_camera, 0] % EVERY == 0]
    shares = []
    for turn in (-TURNED, TURNED):
        turned = x.copy()
        turned[np.arange(unknowns.cameras) * OF_CAMERA + ROLL] += turn
        road = road_residuals(views, unknowns, turned, most_px, signals, groups)
        seen = values(unknowns, road, turned)
        expected = seen - values(unknowns, road, x)
        squares, camera = (expected**2).sum(-1), unknowns.groups[road.group, 1]
        share = (seen * expected).sum(-1) / np.maximum(squares, SHORTEST)
        shares.append([_median(share[camera == c], squares[camera == c]) for c in range(unknowns.cameras)])
    return np.mean(shares, axis=0)


def _median(values: Array, weights: Array) -> float:
    """The weighted median; 1 of nothing."""
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(reached, reached[-1] / 2)]) if weights.any() else 1.0


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
