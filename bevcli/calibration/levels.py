"""The surface that a camera has measured its height from: the road, or a pavement that is higher by a kerb.

Points that one camera sees in the first frame of a pair and its neighbour in the second tell their heights above each
other. Where these contradict the road, one of the cameras sees another surface.
"""

import numpy as np
from numpy.typing import NDArray

from bevcli.calibration.residuals import EpipolarResiduals, RoadResiduals, values
from bevcli.calibration.unknowns import HEIGHT, OF_CAMERA, Indices, Unknowns
from bevcli.geometry.transforms import Array

STARTS_M = np.arange(-0.45, 0.46, 0.15)  # of a camera's height, about the present one
LEAST_STEP_M = 0.08  # smaller steps are no kerb
MOST_PX = 60.0  # residual of a point that may fit after a step
SCALES_PX = (6.0, 3.0, 1.5, 1.0, 1.0)  # of Cauchy's loss, step by step
FITS_PX = 1.0
LEAST_GAIN, LEAST_SHARE = 10, 0.3  # points that fit after a step and did not before: number, and share of those before
WAY_M, FEWEST_ON_WAY = 2.0, 60  # distance from the vehicle's way that is road for sure; points there
FEWEST_TIES, LEAST_TIED = 60, 0.04  # shared points that fit: number, and share of all, which wrong matches do not reach
DIFFERENCE_M = 1e-5  # for derivatives


def level_corrections(unknowns: Unknowns, ties: EpipolarResiduals, x: Array) -> Array:
    """(P,) corrections of x (P,): of the positions of cameras on another level than their neighbours; 0 for most.

    ties: points that two cameras share.
    """
    ties = ties.where(np.abs(values(unknowns, ties, x)[:, 0]) < MOST_PX)
    corrected = x.copy()
    for _ in range(unknowns.cameras):  # the largest contradiction first: it may be the cause of others
        found = [_best(unknowns, ties, corrected, camera) for camera in range(unknowns.cameras)]
        gain, camera = max((each[0], camera) for camera, each in enumerate(found))
        if gain <= 0:
            break
        corrected = found[camera][1]
    return corrected - x


def sees_road(unknowns: Unknowns, road: RoadResiduals, ties: EpipolarResiduals, x: Array) -> NDArray[np.bool_]:
    """(C,) the cameras that have measured their height from the road, and not from a pavement.

    They see the road right where the vehicle drives, or many of the points that they share with a neighbour fit.
    """
    fits = np.linalg.norm(values(unknowns, road, x), axis=-1) < FITS_PX
    on_way = unknowns.groups[road.group[fits & (road.beside_m < WAY_M)], 1]
    seen = np.bincount(on_way, minlength=unknowns.cameras) >= FEWEST_ON_WAY
    tied = []
    for camera in range(unknowns.cameras):
        mine = ties.where((unknowns.groups[ties.group, 1:] == camera).any(-1))
        tied.append(_fitting(unknowns, mine, x) >= max(FEWEST_TIES, LEAST_TIED * len(mine.group)))
    return seen | np.array(tied)


def _best(unknowns: Unknowns, ties: EpipolarResiduals, x: Array, camera: int) -> tuple[float, Array]:
    """How many more points fit with a camera on another level, beyond what chance may do; and x with it there."""
    mine = ties.where((unknowns.groups[ties.group, 1:] == camera).any(-1))
    columns = OF_CAMERA * camera + np.arange(HEIGHT - 2, HEIGHT + 1)
    before = _fitting(unknowns, mine, x)
    best, gain = x, 0.0
    for start in STARTS_M:
        moved = _positioned(unknowns, mine, x + start * (np.arange(len(x)) == columns[-1]), columns)
        more = _fitting(unknowns, mine, moved) - (1 + LEAST_SHARE) * before - LEAST_GAIN
        if more > gain and abs(moved[columns[-1]] - x[columns[-1]]) >= LEAST_STEP_M:
            best, gain = moved, more
    return gain, best


def _fitting(unknowns: Unknowns, ties: EpipolarResiduals, x: Array) -> int:
    return int((np.abs(values(unknowns, ties, x)) < FITS_PX).sum())


def _positioned(unknowns: Unknowns, ties: EpipolarResiduals, x: Array, columns: Indices) -> Array:
    """x with the position of a camera, its unknowns at `columns`, where the points that it shares fit best."""
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
