"""Scores as one JSON object, with the nuScenes devkit's key names and ours beside them."""

from __future__ import annotations

import math
from typing import Any

from bevcli.evaluation.config import DetectionConfig
from bevcli.evaluation.detection_scores import DetectionScores, ScoreTable, VisibilityRecall
from bevcli.evaluation.segmentation import SegmentationScores


def scores_to_json(
    detection: DetectionScores,
    config: DetectionConfig,
    segmentation: SegmentationScores | None = None,
    notes: tuple[str, ...] = (),
) -> dict[str, Any]:
    """All scores; a number that is not defined is None. docs/scoring.md says what each key means."""
    present = detection.overall.of_classes_with_ground_truth()
    content = {
        **_table(detection.overall),
        "classes_with_ground_truth": {
            "classes": list(present.classes),
            "mean_ap": present.mean_ap,
            "nd_score": present.nd_score,
        },
        "by_range": [{"from_m": part.low_m, "to_m": part.high_m, **_table(part.table)} for part in detection.by_range],
        "recall_by_visibility": [_visibility(part) for part in detection.by_visibility],
        "iou": None if segmentation is None else dict(segmentation.iou),
        "frames": detection.frame_count,
        "map_frames": 0 if segmentation is None else segmentation.frame_count,
        "ground_truth_boxes": detection.ground_truth_count,
        "prediction_boxes": detection.prediction_count,
        "notes": list(notes),
        "cfg": {
            "class_range": dict(config.class_ranges_m),
            "dist_ths": list(config.distances_m),
            "dist_th_tp": config.error_distance_m,
            "min_recall": config.min_recall,
            "min_precision": config.min_precision,
            "mean_ap_weight": config.mean_ap_weight,
        },
    }
    return _finite(content)


def _table(table: ScoreTable) -> dict[str, Any]:
    return {
        "mean_ap": table.mean_ap,
        "nd_score": table.nd_score,
        "tp_errors": table.errors,
        "tp_scores": table.error_scores,
        "label_aps": {
            name: {f"{distance:.1f}": ap for distance, ap in scores.aps.items()}
            for name, scores in table.classes.items()
        },
        "mean_dist_aps": {name: scores.mean_ap for name, scores in table.classes.items()},
        "label_tp_errors": {name: dict(scores.errors) for name, scores in table.classes.items()},
        "label_recalls": {name: scores.recall for name, scores in table.classes.items()},
        "label_ground_truth_boxes": {name: scores.ground_truth_count for name, scores in table.classes.items()},
    }


def _visibility(part: VisibilityRecall) -> dict[str, Any]:
    return {
        "from": part.low,
        "to": part.high,
        "recall": part.mean_recall,
        "ground_truth_boxes": part.ground_truth_count,
        "found_boxes": part.found_count,
        "label_recalls": dict(part.recalls),
    }


def _finite(value: Any) -> Any:
    """The same with None for NaN and infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
