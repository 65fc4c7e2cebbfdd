"""Which boxes were found, missed or made up: predictions against ground truth, for display only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D

MATCH_DISTANCE_M = 2.0  # of the centres on the ground, as in nuScenes' detection score


def counted(truth: Boxes3D, grid: BevGrid) -> Boxes3D:
    """The ground-truth boxes, in the bev frame, that a model could find: in its grid, and seen by some sensor."""
    inside = (grid.cell_of(truth.centers[:, :2]) >= 0).all(-1)
    seen = np.ones(len(truth), dtype=bool) if truth.num_points is None else truth.num_points != 0
    return truth[inside & seen]


def match(predicted: Boxes3D, truth: Boxes3D) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which predictions (N,) are true, and which ground-truth boxes (M,) were found; both in one frame.

    Predictions, best first, each take the nearest free box of their class within MATCH_DISTANCE_M.
    """
    true, found = np.zeros(len(predicted), dtype=bool), np.zeros(len(truth), dtype=bool)
    if not len(predicted) or not len(truth):
        return true, found
    away = np.linalg.norm(predicted.centers[:, None, :2] - truth.centers[None, :, :2], axis=-1)
    away[predicted.classes[:, None] != truth.classes[None]] = np.inf
    scores = np.ones(len(predicted)) if predicted.scores is None else predicted.scores
    for i in np.argsort(-scores, kind="stable"):
        nearest = int(np.argmin(np.where(found, np.inf, away[i])))
        if not found[nearest] and away[i, nearest] <= MATCH_DISTANCE_M:
            true[i] = found[nearest] = True
    return true, found
