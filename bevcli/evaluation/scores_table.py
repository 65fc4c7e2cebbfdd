"""Scores as text for a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from bevcli.evaluation.config import ERRORS
from bevcli.evaluation.detection_scores import ClassScores, DetectionScores
from bevcli.evaluation.segmentation import SegmentationScores

_ERROR_HEADS = ("ATE m", "ASE", "AOE rad", "AVE m/s", "AAE")


def scores_table(detection: DetectionScores, segmentation: SegmentationScores | None = None) -> str:
    """Detection by class, by range and by visibility, and IoU where there are maps; lines of at most 110 characters."""
    parts = [_classes(detection), _ranges(detection)]
    if detection.by_visibility:
        parts.append(_visibilities(detection))
    if segmentation is not None:
        parts.append(_maps(segmentation))
    return "\n\n".join(parts)


def _classes(detection: DetectionScores) -> str:
    table = detection.overall
    distances = [f"AP@{distance:g}m" for distance in next(iter(table.classes.values())).aps]
    rows = [("class", "boxes", "AP", *distances, "recall", *_ERROR_HEADS)]
    rows += [_class_row(name, scores) for name, scores in table.classes.items()]
    means = [_number(table.errors[name]) for name in ERRORS]
    rows.append(("all", str(detection.ground_truth_count), _number(table.mean_ap), *[""] * len(distances), "", *means))
    return f"{_aligned(rows)}\n\nmAP {_number(table.mean_ap)}   NDS {_number(table.nd_score)}"


def _class_row(name: str, scores: ClassScores) -> tuple[str, ...]:
    aps = [_number(ap) for ap in scores.aps.values()]
    errors = [_number(scores.errors[error]) for error in ERRORS]
    return (name, str(scores.ground_truth_count), _number(scores.mean_ap), *aps, _number(scores.recall), *errors)


def _ranges(detection: DetectionScores) -> str:
    bins = detection.by_range
    rows = [("AP by range", *(f"{part.low_m:g}-{part.high_m:g} m" for part in bins))]
    for name in detection.overall.classes:
        found = [part.table.classes.get(name) for part in bins]
        rows.append((name, *(_number(scores.mean_ap) if scores else "-" for scores in found)))
    rows.append(("mAP of these", *(_number(part.table.mean_ap) for part in bins)))
    rows.append(("NDS of these", *(_number(part.table.nd_score) for part in bins)))
    return _aligned(rows)


def _visibilities(detection: DetectionScores) -> str:
    rows = [("visibility", "boxes", "found", "recall, mean over classes")]
    for part in detection.by_visibility:
        percent = f"{100 * part.low:.0f}-{100 * part.high:.0f} %"
        rows.append((percent, str(part.ground_truth_count), str(part.found_count), _number(part.mean_recall)))
    return _aligned(rows)


def _maps(segmentation: SegmentationScores) -> str:
    rows = [("map class", "IoU"), *((name, _number(iou)) for name, iou in segmentation.iou.items())]
    return f"{_aligned(rows)}\n({segmentation.frame_count} maps)"


def _aligned(rows: Iterable[Sequence[str]]) -> str:
    """The first column to the left, the others to the right."""
    lines = list(rows)
    widths = [max(len(cell) for cell in column) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if place else cell.ljust(width)
            for place, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3f}"
