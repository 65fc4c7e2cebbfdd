"""Plots of detection scores: precision and recall, and errors by range."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bevcli.errors import OutputError
from bevcli.evaluation.config import ERRORS
from bevcli.evaluation.detection_scores import ClassScores, DetectionScores
from bevcli.evaluation.precision_recall import RECALLS

# Colours of classes on a white background.
PLOT_COLORS = {
    "car": "#1f77b4", "truck": "#ff7f0e", "construction_vehicle": "#bcbd22", "bus": "#9467bd", "trailer": "#8c564b",
    "barrier": "#7f7f7f", "motorcycle": "#d62728", "bicycle": "#2ca02c", "pedestrian": "#e377c2",
    "traffic_cone": "#17becf",
}  # fmt: skip
_GRID_COLOR = "#e6e6e6"
_DISTANCE_COLORS = ("#b8c9e8", "#7d9fd3", "#3f6fb5", "#173e7a")  # from the shortest matching distance to the longest
_ERROR_TITLES = {
    "trans_err": "translation error (m)",
    "scale_err": "scale error (1 - IoU)",
    "orient_err": "orientation error (rad)",
    "vel_err": "velocity error (m/s)",
    "attr_err": "attribute error (1 - accuracy)",
}


def titled_figure(size_inches: tuple[float, float], title: str, subtitle: str) -> Figure:
    """A figure with a heading. It needs no screen and changes no global state of matplotlib."""
    figure = Figure(figsize=size_inches, layout="constrained")
    figure.suptitle(f"{title}\n", fontsize=15, fontweight="bold", x=0.01, ha="left")
    figure.text(0.01, 0.955, subtitle, fontsize=10, color="#555555", ha="left", va="top")
    return figure


def save_figures(figures: Mapping[str, Figure], folder: Path) -> list[Path]:
    """Write figures, by file name, into a folder, made where it is missing; return their paths. Raises OutputError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, figure in figures.items():
            figure.savefig(folder / name, dpi=110)
    except OSError as error:
        raise OutputError(f"{folder}: plots cannot be written ({error.strerror})") from None
    return [folder / name for name in figures]


def draw_precision_recall(detection: DetectionScores) -> Figure:
    """One panel a class, with one curve for each matching distance."""
    table = detection.overall
    figure = titled_figure(
        (15, 7), "Precision and recall by class", f"mAP {table.mean_ap:.3f}, one curve for each matching distance"
    )
    panels = figure.subplots(2, (len(table.classes) + 1) // 2, sharex=True, sharey=True)
    for axes, (name, scores) in zip(panels.flat, table.classes.items(), strict=False):
        _draw_precision_recall(axes, name, scores)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", ncols=len(labels), frameon=False, title="matching distance")
    for axes in panels[-1]:
        axes.set_xlabel("recall")
    for axes in panels[:, 0]:
        axes.set_ylabel("precision")
    return figure


def draw_errors_by_range(detection: DetectionScores) -> Figure:
    """AP and the five true-positive errors by distance from the ego vehicle, for each class and their mean."""
    bins = [part for part in detection.by_range if part.table.classes]
    figure = titled_figure(
        (15, 8.5), "AP and errors by range", "thick: mean of the classes; no point where nothing was found"
    )
    panels = figure.subplots(2, 3, sharex=True)
    middles = [(part.low_m + part.high_m) / 2 for part in bins]
    for axes, error in zip(panels.flat, (None, *ERRORS), strict=True):
        for name in detection.overall.classes:
            found = [part.table.classes.get(name) for part in bins]
            values = [_value(scores, error) for scores in found]
            axes.plot(middles, values, color=PLOT_COLORS[name], linewidth=1, marker=".", label=name, alpha=0.8)
        means = [part.table.mean_ap if error is None else part.table.errors[error] for part in bins]
        axes.plot(middles, means, color="black", linewidth=2.5, marker="o", label="mean")
        axes.set_title("AP" if error is None else _ERROR_TITLES[error], fontsize=11)
        axes.set_ylim(bottom=0)
        axes.set_xticks(sorted({end for part in bins for end in (part.low_m, part.high_m)}))
        axes.grid(color=_GRID_COLOR)
    for axes in panels[-1]:
        axes.set_xlabel("distance from the ego vehicle (m)")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False)
    return figure


def _draw_precision_recall(axes: Axes, name: str, scores: ClassScores) -> None:
    axes.set_title(f"{name}  AP {scores.mean_ap:.2f}", fontsize=11, loc="left")
    for (distance, curve), color in zip(scores.curves.items(), _DISTANCE_COLORS, strict=False):
        reached = curve.score > 0
        axes.plot(RECALLS[reached], curve.precision[reached], color=color, linewidth=2, label=f"{distance:g} m")
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1.02)
    axes.grid(color=_GRID_COLOR)
    aps = " · ".join(f"{ap:.2f}" for ap in scores.aps.values())
    text = f"{scores.ground_truth_count} boxes, APs {aps}" if scores.ground_truth_count else "no ground truth"
    axes.text(0.98, 0.03, text, ha="right", va="bottom", fontsize=8, color="#555555", transform=axes.transAxes)


def _value(scores: ClassScores | None, error: str | None) -> float:
    """AP (error None) or an error of a class in a bin; NaN without true positives."""
    if scores is None:
        return np.nan
    if error is None:
        return scores.mean_ap
    return scores.errors[error] if scores.recall > 0 else np.nan
