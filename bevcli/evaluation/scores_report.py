"""Scores as a dict for JSON, with the key names of the nuScenes devkit, and as a table for the terminal."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from bevcli.evaluation.config import ERRORS
from bevcli.evaluation.detection import DetectionScores, ScoreTable
from bevcli.evaluation.segmentation import SegmentationScores
from bevcli.printing import aligned, counted
from bevcli.workshop.tracking_scores.scoring import METRICS, TrackingScores
from bevcli.workshop.vad.driving_scores import DrivingScores
from bevcli.workshop.vad.line_scores import THRESHOLDS_M
from bevcli.workshop.vad.planning_scores import PlanScores

_ERROR_HEADS = ("ATE m", "ASE", "AOE rad", "AVE m/s", "AAE")


@dataclass(frozen=True)
class FrameScores:
    """The scores of the boxes, maps and tracks of some frames.

    Attributes:
        detection: the scores of the boxes.
        segmentation: the scores of the maps; None where predictions or ground truth have none.
        tracking: the scores of the tracks; None if they were not asked for.
        notes: what was assumed or left out, one line each.
    """

    detection: DetectionScores
    segmentation: SegmentationScores | None = None
    tracking: TrackingScores | None = None
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """All scores as a dict for JSON; undefined numbers are None. docs/scoring.md explains the keys."""
        return finite(_content(self))

    def table(self) -> str:
        """The scores of boxes by class, range and visibility, and those of maps and tracks, as text for a terminal."""
        parts = [_classes(self.detection), _ranges(self.detection)]
        if self.detection.by_visibility:
            parts.append(_visibilities(self.detection))
        if self.segmentation is not None:
            parts.append(_maps(self.segmentation))
        if self.tracking is not None:
            parts.append(_tracks(self.tracking))
        return "\n\n".join(parts)


def _content(scores: FrameScores) -> dict[str, Any]:
    detection, segmentation = scores.detection, scores.segmentation
    present, config = detection.overall.of_classes_with_ground_truth(), detection.config
    return {
        **_table_to_dict(detection.overall),
        "classes_with_ground_truth": {
            "classes": list(present.classes),
            "mean_ap": present.mean_ap,
            "nd_score": present.nd_score,
        },
        "by_range": [
            {"from_m": low, "to_m": high, **_table_to_dict(table)} for (low, high), table in detection.by_range.items()
        ],
        "recall_by_visibility": [
            {
                "from": low,
                "to": high,
                "recall": table.mean_recall,
                "ground_truth_boxes": table.ground_truth_count,
                "found_boxes": table.prediction_count,
                "label_recalls": {name: one.recall for name, one in table.classes.items()},
            }
            for (low, high), table in detection.by_visibility.items()
        ],
        "iou": None if segmentation is None else dict(segmentation.iou),
        "frames": detection.frame_count,
        "map_frames": 0 if segmentation is None else segmentation.frame_count,
        "ground_truth_boxes": detection.overall.ground_truth_count,
        "prediction_boxes": detection.overall.prediction_count,
        "notes": list(scores.notes),
        "cfg": {
            "class_range": dict(config.class_ranges_m),
            "dist_ths": list(config.distances_m),
            "dist_th_tp": config.error_distance_m,
            "min_recall": config.min_recall,
            "min_precision": config.min_precision,
            "mean_ap_weight": config.mean_ap_weight,
        },
        **({} if scores.tracking is None else {"tracking": _tracking_to_dict(scores.tracking)}),
    }


def _table_to_dict(table: ScoreTable) -> dict[str, Any]:
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


def finite(value: Any) -> Any:
    """The value with None in place of NaN and infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _classes(detection: DetectionScores) -> str:
    table = detection.overall
    distances = [f"AP@{distance:g}m" for distance in next(iter(table.classes.values())).aps]
    rows = [("class", "boxes", "AP", *distances, "recall", *_ERROR_HEADS)]
    for name, scores in table.classes.items():
        numbers = (scores.mean_ap, *scores.aps.values(), scores.recall, *(scores.errors[error] for error in ERRORS))
        rows.append((name, str(scores.ground_truth_count), *map(_number, numbers)))
    means = [_number(table.errors[name]) for name in ERRORS]
    rows.append(("all", str(table.ground_truth_count), _number(table.mean_ap), *[""] * len(distances), "", *means))
    return f"{aligned(rows)}\n\nmAP {_number(table.mean_ap)}   NDS {_number(table.nd_score)}"


def _ranges(detection: DetectionScores) -> str:
    bins = detection.by_range
    rows = [("AP by range", *(f"{low:g}-{high:g} m" for low, high in bins))]
    for name in detection.overall.classes:
        found = [table.classes.get(name) for table in bins.values()]
        rows.append((name, *(_number(scores.mean_ap) if scores else "-" for scores in found)))
    rows.append(("mAP", *(_number(table.mean_ap) for table in bins.values())))
    rows.append(("NDS", *(_number(table.nd_score) for table in bins.values())))
    return aligned(rows)


def _visibilities(detection: DetectionScores) -> str:
    rows = [("visibility", "boxes", "found", "recall, mean over classes")]
    for (low, high), table in detection.by_visibility.items():
        counts = (str(table.ground_truth_count), str(table.prediction_count))
        rows.append((f"{100 * low:.0f}-{100 * high:.0f} %", *counts, _number(table.mean_recall)))
    return aligned(rows)


def _maps(segmentation: SegmentationScores) -> str:
    rows = [("map class", "IoU"), *((name, _number(iou)) for name, iou in segmentation.iou.items())]
    return f"{aligned(rows)}\n({segmentation.frame_count} maps)"


def _number(value: float, digits: int = 3) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


# Column -> metric and number of decimals, in two tables.
_QUALITY = {
    "AMOTA": ("amota", 3), "AMOTP m": ("amotp", 3), "MOTA": ("mota", 3), "MOTP m": ("motp", 3), "recall": ("recall", 3),
    "MOTAR": ("motar", 3), "GT": ("gt", 0), "MT": ("mt", 0), "ML": ("ml", 0),
}  # fmt: skip
_ERRORS = {
    "TP": ("tp", 0), "FP": ("fp", 0), "FN": ("fn", 0), "IDS": ("ids", 0), "FRAG": ("frag", 0), "FAF": ("faf", 1),
    "TID s": ("tid", 2), "LGD s": ("lgd", 2),
}  # fmt: skip


def _tracks(scores: TrackingScores) -> str:
    """The tracking metrics by class, and their sums or means over the classes, in two tables."""
    overall = scores.overall
    rows = {**{name: scored.metrics for name, scored in scores.classes.items()}, "all": overall}
    tables = []
    for columns in (_QUALITY, _ERRORS):
        cells = [
            (name, *(_number(values[metric], digits) for metric, digits in columns.values()))
            for name, values in rows.items()
        ]
        tables.append(aligned([("class", *columns), *cells]))
    switches = overall["ids"] / scores.scenes if scores.scenes else math.nan
    heading = (
        f"AMOTA {_number(overall['amota'])}   AMOTP {_number(overall['amotp'])} m   "
        f"identity switches {_number(switches, 1)} per scene (scenes: {scores.scenes}, frames: {scores.frames})"
    )
    return "\n\n".join([*tables, heading])


def _tracking_to_dict(scores: TrackingScores) -> dict[str, Any]:
    config = scores.config
    return {
        "label_metrics": {
            name: {label: scored.metrics[name] for label, scored in scores.classes.items()} for name in METRICS
        },
        **scores.overall,
        "best_thresholds": {name: scored.best_threshold for name, scored in scores.classes.items()},
        "scenes": scores.scenes,
        "frames": scores.frames,
        "cfg": {
            "class_range": {name: float(limit) for name, limit in config.class_ranges_m.items()},
            "dist_th_tp": config.match_distance_m,
            "num_thresholds": config.recall_levels,
            "min_recall": config.min_recall,
        },
    }


def driving_to_dict(scores: DrivingScores) -> dict[str, Any]:
    """The scores as a dict for JSON."""
    content: dict[str, Any] = {}
    if (lines := scores.lines) is not None:
        aps = {name: {f"{limit:.1f}": ap for limit, ap in of_class.items()} for name, of_class in lines.ap.items()}
        content["map"] = {
            "mean_ap": lines.mean_ap,
            "label_aps": aps,
            "mean_dist_aps": lines.mean_by_class,
            "ground_truth_lines": dict(lines.truth_count),
            "frames": lines.frame_count,
        }
    if (motion := scores.motion) is not None:
        content["motion"] = {name: {**sums.metrics, "ground_truth": sums.truths} for name, sums in motion.items()}
    if (plan := scores.plan) is not None:
        content["plan"] = {
            "averaged_up_to_horizon": _horizons(plan, plan.averaged, plan.collisions),
            "at_horizon": _horizons(plan, plan.at, plan.collisions_with_vehicles),
            "frames": len(plan.distances_m),
        }
    return content


def _horizons(plan: PlanScores, of: Callable[[Any, float], float], collisions: Any) -> dict[str, dict[str, float]]:
    """Distances and shares of collisions by horizon, in one convention."""
    seconds = [s for s in (1, 2, 3) if s <= plan.step_s * plan.distances_m.shape[1] + 1e-6]
    return {
        "L2": {f"{s}s": of(plan.distances_m, s) for s in seconds},
        "collision": {f"{s}s": of(collisions, s) for s in seconds},
    }


def driving_tables(scores: DrivingScores) -> Iterator[str]:
    """One table for each kind of scores that was asked for."""
    if (lines := scores.lines) is not None:
        rows = [("map line", "lines", "AP", *(f"AP@{limit:g}m" for limit in THRESHOLDS_M))]
        for name, of_class in lines.ap.items():
            numbers = (lines.mean_by_class[name], *of_class.values())
            rows.append((name, str(lines.truth_count[name]), *map(_number, numbers)))
        yield f"{aligned(rows)}\n\nmap mAP {_number(lines.mean_ap)} ({counted(lines.frame_count, 'frames')})"
    if (motion := scores.motion) is not None:
        rows = [("forecasts", "objects", "EPA", "minADE m", "minFDE m", "miss rate")]
        for name, sums in motion.items():
            rows.append((name, str(sums.truths), *map(_number, sums.metrics.values())))
        yield aligned(rows)
    if (plan := scores.plan) is not None:
        averaged = _horizons(plan, plan.averaged, plan.collisions)
        at = _horizons(plan, plan.at, plan.collisions_with_vehicles)
        rows = [("planned path", *averaged["L2"], "", *averaged["L2"])]
        for name, unit, factor in (("L2", "m", 1), ("collision", "%", 100)):
            cells = [[_number(factor * value) for value in of[name].values()] for of in (averaged, at)]
            rows.append((f"{name} {unit}", *cells[0], "", *cells[1]))
        explained = "left: mean up to the horizon (ST-P3, VAD); right: at the horizon, vehicles only (UniAD)"
        yield f"{aligned(rows)}\n({len(plan.distances_m)} paths; {explained})"
