"""True positives, false positives, duplicates and missed ground truth of one frame, for display."""

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


Matches = tuple[NDArray[np.bool_], NDArray[np.bool_]]
"""Which predictions (N,) are true positives, and which ground-truth boxes (M,) are found."""


def false_and_duplicate(
    predictions: Boxes3D, ground_truth: Boxes3D | None, matches: Matches | None = None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which predictions (N,) are false positives, and which (N,) are a second box on an object.

    A duplicate is no true positive, and either the tracker marked it, or the ground truth of its class within 2 m was
    found by a better box. Without ground truth no box is a false positive, and the tracker's marks are returned.

    matches: of `true_positives`, where the caller has them already.
    """
    marked = predictions.duplicates if predictions.duplicates is not None else np.zeros(len(predictions), dtype=bool)
    if ground_truth is None:
        return np.zeros(len(predictions), dtype=bool), marked
    true, found = true_positives(predictions, ground_truth) if matches is None else matches
    truths = ground_truth[found]
    away = np.linalg.norm(predictions.centers[:, None, :2] - truths.centers[:, :2], axis=-1)  # (N, M)
    near = (away < MATCH_DISTANCE_M) & (predictions.classes[:, None] == truths.classes)
    duplicate = ~true & (marked | near.any(-1))
    return ~true & ~duplicate, duplicate


def true_positives(predictions: Boxes3D, ground_truth: Boxes3D) -> Matches:
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
