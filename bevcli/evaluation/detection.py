"""Detection scores: boxes in, nuScenes' AP, mAP, true-positive errors and NDS out. No files."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from bevcli.evaluation.class_matches import ClassMatches, match_class
from bevcli.evaluation.config import MEANINGLESS_ERRORS, DetectionConfig
from bevcli.evaluation.detection_scores import (
    ClassScores,
    DetectionScores,
    RangeScores,
    ScoreTable,
    VisibilityRecall,
)
from bevcli.evaluation.precision_recall import recall_curve
from bevcli.evaluation.scored_boxes import ScoredBoxes, gather
from bevcli.evaluation.true_positives import true_positive_errors
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array


def evaluate(
    predictions: Sequence[Boxes3D],
    ground_truth: Sequence[Boxes3D],
    config: DetectionConfig | None = None,
    ego_xy: ArrayLike | None = None,
) -> DetectionScores:
    """Score F frames.

    predictions: each frame's boxes, with scores. ground_truth: the same frames', in the same frame of reference
    (another one for every frame, if you like); boxes with num_points 0 are left out. config: default the devkit's.
    ego_xy: (F, 2) where the ego vehicle stands, metres, for the class ranges; default the origin: ego boxes.

    Equal to nuScenes devkit 1.2.0 (detection_cvpr_2019): a class without ground truth counts with AP 0 and errors
    of 1. One thing differs: an error that ground truth states for no box at all is NaN, and left out of NDS.
    """
    assert len(predictions) == len(ground_truth)
    config = config or DetectionConfig()
    ego = np.zeros((len(predictions), 2)) if ego_xy is None else np.asarray(ego_xy, dtype=np.float64)
    truth, found = gather(ground_truth, ego), gather(predictions, ego)
    truth, found = _with_points(truth), _with_points(found)
    matches = tuple(match_class(name, truth, found, config) for name in config.class_ranges_m)
    unmeasured = _unmeasured(truth.boxes)

    def table(parts: Sequence[ClassMatches]) -> ScoreTable:
        scores = {part.name: _score_class(part, config, unmeasured) for part in parts}
        return ScoreTable(scores, config.mean_ap_weight)

    def within(low: float, high: float) -> RangeScores:
        parts = [part.within(low, high) for part in matches]
        return RangeScores(low, high, table([part for part in parts if part.truth_counts.any()]))

    return DetectionScores(
        frame_count=len(predictions),
        overall=table(matches),
        by_range=tuple(within(*ends) for ends in config.range_bins_m),
        by_visibility=_recall_by_visibility(matches, config),
        unmeasured=unmeasured,
        matches=matches,
    )


def _with_points(boxes: ScoredBoxes) -> ScoredBoxes:
    # On both sides, as the devkit: ground truth that is given as predictions is then perfect.
    assert boxes.boxes.num_points is not None
    return boxes[boxes.boxes.num_points != 0]


def _score_class(part: ClassMatches, config: DetectionConfig, unmeasured: tuple[str, ...]) -> ClassScores:
    truth_count = int(part.truth_counts.sum())
    scores = part.predictions.boxes.scores
    assert scores is not None
    curves = {
        distance: recall_curve(matched[counts] >= 0, scores[counts], truth_count)
        for distance, matched, counts in zip(config.distances_m, part.matched, part.counts, strict=True)
    }
    row = config.distances_m.index(config.error_distance_m)
    hits = np.flatnonzero(part.counts[row] & (part.matched[row] >= 0))
    truths = part.ground_truth.boxes[part.matched[row][hits]]
    errors = true_positive_errors(part.name, truths, part.predictions.boxes[hits])
    curve = curves[config.error_distance_m]
    undefined = {*MEANINGLESS_ERRORS.get(part.name, ()), *unmeasured}
    return ClassScores(
        ground_truth_count=truth_count,
        prediction_count=int(part.counts[row].sum()),
        recall=len(hits) / truth_count if truth_count else float("nan"),
        aps={distance: curve.average_precision(config) for distance, curve in curves.items()},
        errors={
            name: float("nan") if name in undefined else curve.mean_error(config, scores[hits], values)
            for name, values in errors.items()
        },
        curves=curves,
    )


def _unmeasured(truth: Boxes3D) -> tuple[str, ...]:
    """The errors for which no box of the ground truth states anything."""
    if not len(truth):
        return ()
    assert truth.attributes is not None
    unknown = {
        "vel_err": np.isnan(truth.velocities).any(axis=1).all(),
        "attr_err": (truth.attributes == "").all(),
    }
    return tuple(name for name, is_unknown in unknown.items() if is_unknown)


def _recall_by_visibility(matches: Sequence[ClassMatches], config: DetectionConfig) -> tuple[VisibilityRecall, ...]:
    """The bins' recalls; none where ground truth states no visibility."""
    stated = [part for part in matches if not np.isnan(_visibilities(part)).all()]
    row = config.distances_m.index(config.error_distance_m)
    return tuple(_visibility_recall(stated, row, *ends) for ends in config.visibility_bins if stated)


def _visibility_recall(matches: Sequence[ClassMatches], row: int, low: float, high: float) -> VisibilityRecall:
    counts = {}
    for part in matches:
        visibility = _visibilities(part)
        inside = (visibility >= low) & (visibility < (high if high < 1 else np.inf))
        counts[part.name] = (int(part.found(row)[inside].sum()), int(inside.sum()))
    return VisibilityRecall(
        low,
        high,
        ground_truth_count=sum(total for _, total in counts.values()),
        found_count=sum(found for found, _ in counts.values()),
        recalls={name: found / total for name, (found, total) in counts.items() if total},
    )


def _visibilities(part: ClassMatches) -> Array:
    assert part.ground_truth.boxes.visibilities is not None
    return part.ground_truth.boxes.visibilities
