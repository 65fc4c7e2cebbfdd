"""Tracking scores as a table for the terminal, and as a dict for JSON with the key names of the nuScenes devkit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from bevcli.evaluation.tracking.class_metrics import METRICS
from bevcli.evaluation.tracking.scoring import TrackingScores

# Column -> metric and number of decimals, in two tables.
_QUALITY = {
    "AMOTA": ("amota", 3), "AMOTP m": ("amotp", 3), "MOTA": ("mota", 3), "MOTP m": ("motp", 3), "recall": ("recall", 3),
    "MOTAR": ("motar", 3), "GT": ("gt", 0), "MT": ("mt", 0), "ML": ("ml", 0),
}  # fmt: skip
_ERRORS = {
    "TP": ("tp", 0), "FP": ("fp", 0), "FN": ("fn", 0), "IDS": ("ids", 0), "FRAG": ("frag", 0), "FAF": ("faf", 1),
    "TID s": ("tid", 2), "LGD s": ("lgd", 2),
}  # fmt: skip


def tracking_table(scores: TrackingScores) -> str:
    """The tracking metrics by class, and their sums or means over the classes, in two tables."""
    overall = scores.overall
    rows = {**{name: scored.metrics for name, scored in scores.classes.items()}, "all": overall}
    tables = [_table(rows, columns) for columns in (_QUALITY, _ERRORS)]
    switches = overall["ids"] / scores.scenes if scores.scenes else math.nan
    heading = (
        f"AMOTA {_number(overall['amota'], 3)}   AMOTP {_number(overall['amotp'], 3)} m   "
        f"identity switches {_number(switches, 1)} per scene (scenes: {scores.scenes}, frames: {scores.frames})"
    )
    return "\n\n".join([*tables, heading])


def tracking_to_dict(scores: TrackingScores) -> dict[str, Any]:
    """The tracking metrics as a dict for JSON; undefined numbers are None. docs/scoring.md explains the keys."""
    by_metric = {name: {c: scored.metrics[name] for c, scored in scores.classes.items()} for name in METRICS}
    config = scores.config
    return {
        "label_metrics": {
            name: {label: _known(value) for label, value in values.items()} for name, values in by_metric.items()
        },
        **{name: _known(value) for name, value in scores.overall.items()},
        "best_thresholds": {name: _known(scored.best_threshold) for name, scored in scores.classes.items()},
        "scenes": scores.scenes,
        "frames": scores.frames,
        "cfg": {
            "class_range": {name: _known(limit) for name, limit in config.class_ranges_m.items()},
            "dist_th_tp": config.match_distance_m,
            "num_thresholds": config.recall_levels,
            "min_recall": config.min_recall,
        },
    }


def _table(rows: Mapping[str, Mapping[str, float]], columns: Mapping[str, tuple[str, int]]) -> str:
    cells = [["class", *columns]]
    cells += [[name, *(_number(values[m], digits) for m, digits in columns.values())] for name, values in rows.items()]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join(
        "  ".join(
            [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        )
        for row in cells
    )


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
