"""The surface that a camera has measured its height from: the road, or a pavement that is higher by a kerb.

Points that one camera sees in the first frame of a pair and its neighbour in the second tell their heights above each
other. Where these contradict the road, one of the cameras sees another surface.
"""

import numpy as np

from bevcli.calibration.residuals import EpipolarResiduals, values
from bevcli.calibration.unknowns import HEIGHT, OF_CAMERA, Unknowns
from bevcli.geometry.transforms import Array

STEPS_M = np.arange(-0.6, 0.61, 0.02)
LEAST_STEP_M = 0.08  # smaller steps are no kerb
MOST_PX = 60.0  # residual of a point that may fit after a step
FITS_PX = 1.0
LEAST_GAIN, LEAST_SHARE = 10, 0.3  # points that fit after a step and did not before: number, and share of those before


def level_corrections(unknowns: Unknowns, ties: EpipolarResiduals, x: Array) -> Array:
    """(C,) corrections of the heights in x (P,), metres, of cameras on another level than their neighbours; 0 for most.

    ties: points that two cameras share.
    """
    ties = ties.where(np.abs(values(unknowns, ties, x)[:, 0]) < MOST_PX)
    corrections = np.zeros(unknowns.cameras)
    for _ in range(2 * unknowns.cameras):  # the largest contradiction first: it may be the cause of others
        found = [_step(unknowns, ties, x, corrections, camera) for camera in range(unknowns.cameras)]
        gain, step, camera = max((*each, camera) for camera, each in enumerate(found))
        if gain <= 0:
            break
        corrections[camera] += step
    return corrections


def _step(
    unknowns: Unknowns, ties: EpipolarResiduals, x: Array, corrections: Array, camera: int
) -> tuple[float, float]:
    """How many more points fit after the best step of a camera's height, beyond what chance may do; and the step."""
    mine = ties.where((unknowns.groups[ties.group, 1:] == camera).any(-1))
    heights = np.arange(unknowns.cameras) * OF_CAMERA + HEIGHT
    fitting = []
    for step in STEPS_M:
        moved = x.copy()
        moved[heights] += corrections
        moved[heights[camera]] += step
        fitting.append(int((np.abs(values(unknowns, mine, moved)) < FITS_PX).sum()))
    best, stay = int(np.argmax(fitting)), fitting[int(np.abs(STEPS_M).argmin())]
    if abs(STEPS_M[best]) < LEAST_STEP_M:
        return 0.0, 0.0
    return fitting[best] - (1 + LEAST_SHARE) * stay - LEAST_GAIN, float(STEPS_M[best])
