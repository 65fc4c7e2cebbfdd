"""Scores as images: precision against recall, errors by range, and where things were missed or invented."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bevcli.errors import OutputError
from bevcli.evaluation.bev_sheet import draw_bev_sheet
from bevcli.evaluation.config import ERRORS
from bevcli.evaluation.detection_scores import ClassScores, DetectionScores
from bevcli.evaluation.plot_style import CLASS_COLORS, GRID, titled_figure
from bevcli.evaluation.precision_recall import RECALLS
from bevcli.evaluation.scoring import Scores

_ERROR_TITLES = {
    "trans_err": "translation error (m)",
    "scale_err": "scale error (1 - IoU)",
    "orient_err": "orientation error (rad)",
    "vel_err": "velocity error (m/s)",
    "attr_err": "attribute error (1 - accuracy)",
}
_DISTANCE_COLORS = ("#b8c9e8", "#7d9fd3", "#3f6fb5", "#173e7a")  # light: strict, dark: generous


def write_plots(scores: Scores, folder: Path) -> list[Path]:
    """Write PNGs into a folder, made where it is missing; returns their paths. Raises OutputError."""
    figures = {
        "precision_recall.png": draw_precision_recall(scores.detection),
        "errors_by_range.png": draw_errors_by_range(scores.detection),
        "misses_and_false_alarms.png": draw_bev_sheet(scores),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, figure in figures.items():
            figure.savefig(folder / name, dpi=110)
    except OSError as error:
        raise OutputError(f"{folder}: plots cannot be written ({error.strerror})") from None
    return [folder / name for name in figures]


def draw_precision_recall(detection: DetectionScores) -> Figure:
    """One panel a class, one curve a matching distance."""
    table = detection.overall
    figure = titled_figure(
        (15, 7), "Precision and recall by class", f"mAP {table.mean_ap:.3f}, one curve a matching distance"
    )
    panels = figure.subplots(2, (len(table.classes) + 1) // 2, sharex=True, sharey=True)
    for axes, (name, scores) in zip(panels.flat, table.classes.items(), strict=False):
        _precision_recall_panel(axes, name, scores)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", ncols=len(labels), frameon=False, title="centres closer than")
    for axes in panels[-1]:
        axes.set_xlabel("recall")
    for axes in panels[:, 0]:
        axes.set_ylabel("precision")
    return figure


def draw_errors_by_range(detection: DetectionScores) -> Figure:
    """AP and the five errors over the distance from the ego vehicle: every class thin, their mean thick."""
    bins = [part for part in detection.by_range if part.table.classes]
    figure = titled_figure(
        (15, 8.5), "AP and errors by range", "mean of the classes thick; none where nothing is found"
    )
    panels = figure.subplots(2, 3, sharex=True)
    middles = [(part.low_m + part.high_m) / 2 for part in bins]
    for axes, error in zip(panels.flat, (None, *ERRORS), strict=True):
        for name in detection.overall.classes:
            found = [part.table.classes.get(name) for part in bins]
            values = [_value(scores, error) for scores in found]
            axes.plot(middles, values, color=CLASS_COLORS[name], linewidth=1, marker=".", label=name, alpha=0.8)
        means = [part.table.mean_ap if error is None else part.table.errors[error] for part in bins]
        axes.plot(middles, means, color="black", linewidth=2.5, marker="o", label="mean")
        axes.set_title("AP" if error is None else _ERROR_TITLES[error], fontsize=11)
        axes.set_ylim(bottom=0)
        axes.set_xticks(sorted({end for part in bins for end in (part.low_m, part.high_m)}))
        axes.grid(color=GRID)
    for axes in panels[-1]:
        axes.set_xlabel("distance from the ego vehicle (m)")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False)
    return figure


def _precision_recall_panel(axes: Axes, name: str, scores: ClassScores) -> None:
    axes.set_title(f"{name}  AP {scores.mean_ap:.2f}", fontsize=11, loc="left")
    for (distance, curve), color in zip(scores.curves.items(), _DISTANCE_COLORS, strict=False):
        reached = curve.score > 0
        axes.plot(RECALLS[reached], curve.precision[reached], color=color, linewidth=2, label=f"{distance:g} m")
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1.02)
    axes.grid(color=GRID)
    aps = " · ".join(f"{ap:.2f}" for ap in scores.aps.values())
    text = f"{scores.ground_truth_count} boxes, APs {aps}" if scores.ground_truth_count else "no ground truth"
    axes.text(0.98, 0.03, text, ha="right", va="bottom", fontsize=8, color="#555555", transform=axes.transAxes)


def _value(scores: ClassScores | None, error: str | None) -> float:
    """A class's AP or error in a bin; nothing is drawn where no hit was measured."""
    if scores is None:
        return np.nan
    if error is None:
        return scores.mean_ap
    return scores.errors[error] if scores.recall > 0 else np.nan
