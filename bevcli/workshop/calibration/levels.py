"""The surface that a camera has measured its height from: the road, or a pavement that is higher by a kerb.

Points that one camera sees in the first frame of a pair and its neighbour in the second tell their heights above each
other. Where these contradict the road, one of the cameras sees another surface.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from bevcli.geometry.transforms import Array
from bevcli.workshop.calibration.residuals import EpipolarResiduals, RoadResiduals, values
from bevcli.workshop.calibration.unknowns import HEIGHT, OF_CAMERA, Indices, Unknowns, geometry_at

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
    sets = [each for each in (*np.arange(unknowns.cameras)[:, None], *pairs) if not stays[each].any()]
    for _ in sets:  # the largest contradiction first: it may be the cause of others
        gain, best = max((_best(unknowns, ties, corrected, each) for each in sets), key=lambda found: found[0])
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
        untied = np.array([before[alike == each][:, seen].sum() < FEWEST_TIES for each in alike])
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


def _best(unknowns: Unknowns, ties: EpipolarResiduals, x: Array, cameras: Indices) -> tuple[float, Array]:
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
        slopes = np.stack([(values(unknowns, ties, each)[:, 0] - here) / DIFFERENCE_M for each in steps], axis=-1)
        weighted = slopes / (scale**2 + here**2)[:, None]
        x[columns] -= np.linalg.solve(weighted.T @ slopes + prior, weighted.T @ here + prior @ x[columns])
    return x
