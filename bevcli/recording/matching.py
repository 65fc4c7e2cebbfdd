"""True positives, false positives and missed ground truth of one frame, for display."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bevcli.evaluation.config import DetectionConfig
from bevcli.evaluation.matching import descending_scores, match_greedily
from bevcli.evaluation.scored_boxes import gather
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D

MATCH_DISTANCE_M = DetectionConfig().error_distance_m


def detectable(ground_truth: Boxes3D, grid: BevGrid) -> Boxes3D:
    """The ground-truth boxes, in the bev frame, that a model can find: inside its grid, with sensor points if known."""
    inside = (grid.cell_of(ground_truth.centers[:, :2]) >= 0).all(-1)
    points = ground_truth.num_points
    seen = np.ones(len(ground_truth), dtype=bool) if points is None else points != 0
    return ground_truth[inside & seen]


def true_positives(predictions: Boxes3D, ground_truth: Boxes3D) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Match predictions (N,) and ground truth (M,) of one frame as `bevcli eval` does, at 2 m.

    Returns which predictions (N,) are true positives, and which ground-truth boxes (M,) are found. Predictions without
    scores count as equal.
    """
    is_true, is_found = np.zeros(len(predictions), dtype=bool), np.zeros(len(ground_truth), dtype=bool)
    scores = np.ones(len(predictions)) if predictions.scores is None else predictions.scores
    origin = np.zeros((1, 2))  # ranges from the ego vehicle are not used here
    for name in np.unique(predictions.classes):
        predicted = np.flatnonzero(predictions.classes == name)
        predicted = predicted[descending_scores(scores[predicted])]
        truths = np.flatnonzero(ground_truth.classes == name)
        one, other = gather([ground_truth[truths]], origin), gather([predictions[predicted]], origin)
        matched = match_greedily(one, other, (MATCH_DISTANCE_M,))[0]
        is_true[predicted[matched >= 0]] = True
        is_found[truths[matched[matched >= 0]]] = True
    return is_true, is_found
