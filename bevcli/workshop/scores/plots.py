"""Plots of detection scores: precision and recall, errors by range, misses and false positives from above."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon
from numpy.typing import NDArray

from bevcli.geometry.boxes import ScoredBoxes
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.printing import counted
from bevcli.workshop.scores.detection import ERRORS, RECALLS, ClassScores, DetectionScores, ScoreTable
from bevcli.workshop.scores.inputs import FramePairs
from bevcli.workshop.scores.worst_frames import MODELS, Outcome, best_outcome
from bevcli.writing import whole_file

# Colours of classes on a white background, in the order of the classes; the eleventh has the first again.
_PLOT_COLORS = (
    "#1f77b4", "#ff7f0e", "#bcbd22", "#9467bd", "#8c564b", "#7f7f7f", "#d62728", "#2ca02c", "#e377c2", "#17becf",
)  # fmt: skip
GRID_COLOR = "#e6e6e6"
FIGURE_SUFFIXES = (".pdf", ".svg", ".png")
# From the shortest matching distance to the longest.
BLUES = ("#b8c9e8", "#7d9fd3", "#3f6fb5", "#173e7a")
ORANGES = ("#f8cfa8", "#f0a35e", "#d9752b", "#8f4310")
_ERROR_TITLES = {
    "trans_err": "translation error (m)",
    "scale_err": "scale error (1 - IoU)",
    "orient_err": "orientation error (rad)",
    "vel_err": "velocity error (m/s)",
    "attr_err": "attribute error (1 - accuracy)",
}


def write_plots(detection: DetectionScores, pairs: FramePairs, folder: Path) -> list[Path]:
    """Write the plots of scores into a folder; return their paths. Raises OutputError.

    folder: or a .pdf, .svg or .png file, which gets the curves of precision and recall alone.
    """
    figures = {
        "precision_recall.png": draw_precision_recall(detection),
        "errors_by_range.png": draw_errors_by_range([detection]),
        "misses_and_false_alarms.png": draw_bev_sheet(detection, pairs),
    }
    return save_figures(figures, folder)


def write_comparison(
    detections: Sequence[DetectionScores], pairs: Sequence[FramePairs], files: Sequence[Path], folder: Path
) -> list[Path]:
    """Write curves and errors by range of two models, and the other plot of each. Raises OutputError."""
    figures = {
        "precision_recall_of_both.png": draw_both([detection.overall for detection in detections], files),
        "errors_by_range_of_both.png": draw_errors_by_range(detections),
    }
    for model, detection, of_frames, file in zip(MODELS, detections, pairs, files, strict=True):
        name = f"{model}, {str(file)[-60:]}; "
        figures[f"misses_and_false_alarms_{model}.png"] = draw_bev_sheet(detection, of_frames, name)
    return save_figures(figures, folder)


def titled_figure(size_inches: tuple[float, float], title: str, subtitle: str) -> Figure:
    """A figure with a heading. It needs no screen and changes no global state of matplotlib."""
    figure = Figure(figsize=size_inches, layout="constrained")
    figure.suptitle(f"{title}\n", fontsize=15, fontweight="bold", x=0.01, ha="left")
    figure.text(0.01, 0.955, subtitle, fontsize=10, color="#555555", ha="left", va="top")
    return figure


def save_figures(figures: Mapping[str, Figure], folder: Path) -> list[Path]:
    """Write figures, by file name, into a folder, made where it is missing; return their paths. Raises OutputError.

    folder: or a file of FIGURE_SUFFIXES, which gets the first figure.
    """
    if folder.suffix.lower() in FIGURE_SUFFIXES and not folder.is_dir():
        figures, folder = {folder.name: next(iter(figures.values()))}, folder.parent
    for name, figure in figures.items():
        with whole_file(folder / name, parents=True) as unfinished:
            figure.savefig(unfinished, dpi=110, format=Path(name).suffix[1:].lower())
    return [folder / name for name in figures]


def plot_colors(classes: Iterable[str]) -> dict[str, str]:
    """A colour for each class, by its place among the classes."""
    return dict(zip(classes, cycle(_PLOT_COLORS), strict=False))


def draw_precision_recall(detection: DetectionScores) -> Figure:
    """One panel a class, with one curve for each matching distance."""
    table = detection.overall
    subtitle = f"mAP {table.mean_ap:.3f}, one curve for each matching distance"
    figure = titled_figure((15, 7), "Precision and recall by class", subtitle)
    panels = _class_panels(figure, len(table.classes))
    for axes, (name, scores) in zip(panels.flat, table.classes.items(), strict=False):
        axes.set_title(f"{name}  AP {scores.mean_ap:.2f}", fontsize=11, loc="left")
        _draw_curves(axes, scores, BLUES)
        aps = " · ".join(f"{ap:.2f}" for ap in scores.aps.values())
        text = f"{scores.ground_truth_count} boxes, APs {aps}" if scores.ground_truth_count else "no ground truth"
        _draw_remark(axes, text)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", ncols=len(labels), frameon=False, title="matching distance")
    return figure


def draw_both(tables: Sequence[ScoreTable], files: Sequence[Path]) -> Figure:
    """One panel for each class with ground truth, with the curves of A in blue and of B in orange."""
    rows = zip(MODELS, tables, files, strict=True)
    subtitle = "      ".join(f"{model}: mAP {table.mean_ap:.3f}, {str(file)[-60:]}" for model, table, file in rows)
    figure = titled_figure((15, 7), "Precision and recall of two models by class", subtitle)
    counts = {name: scores.ground_truth_count for name, scores in tables[0].classes.items()}
    shown = [name for name, count in counts.items() if count] or list(counts)
    panels = _class_panels(figure, len(shown))
    for axes, name in zip(panels.flat, shown, strict=False):
        axes.set_title(name, fontsize=11, loc="left")
        for table, colors in zip(tables, (BLUES, ORANGES), strict=True):
            _draw_curves(axes, table.classes[name], colors)
        of_a, of_b = (table.classes[name].mean_ap for table in tables)
        _draw_remark(axes, f"{counted(counts[name], 'boxes')}, AP: A {of_a:.2f}, B {of_b:.2f}")
    lines, distances = panels[0, 0].get_legend_handles_labels()
    half = len(lines) // 2
    order = [index for pair in zip(range(half), range(half, 2 * half), strict=True) for index in pair]  # A above B
    labels = [f"{MODELS[index // half]}  {distances[index]}" for index in order]
    figure.legend([lines[index] for index in order], labels, loc="upper right", ncols=half, frameon=False)
    return figure


def _draw_remark(axes: Axes, text: str) -> None:
    axes.text(0.98, 0.03, text, ha="right", va="bottom", fontsize=8, color="#555555", transform=axes.transAxes)


def _class_panels(figure: Figure, count: int) -> NDArray[Any]:
    """(2, ceil(count / 2)), axes for the curves of classes."""
    panels: NDArray[Any] = figure.subplots(2, (count + 1) // 2, sharex=True, sharey=True, squeeze=False)
    if count % 2:
        panels[-1, -1].set_axis_off()
        panels[0, -1].tick_params(labelbottom=True)
    for axes in panels[-1]:
        axes.set_xlabel("recall")
    for axes in panels[:, 0]:
        axes.set_ylabel("precision")
    return panels


def draw_errors_by_range(detections: Sequence[DetectionScores]) -> Figure:
    """AP and the five true-positive errors by distance from the ego vehicle, for each class and their mean.

    detections: of one model, or of A (lines) and B (dashed); of two, the classes with ground truth.
    """
    both = len(detections) > 1
    classes = detections[0].overall.classes
    with_truth = {name for name, scores in classes.items() if scores.ground_truth_count or not both}
    colors = {name: color for name, color in plot_colors(classes).items() if name in with_truth}
    models = "; A: lines, B: dashed" if both else ""
    subtitle = f"thick: mean of the classes{models}; no point where nothing was found"
    figure = titled_figure((15, 8.5), "AP and errors by range", subtitle)
    panels = figure.subplots(2, 3, sharex=True)
    for axes, error in zip(panels.flat, (None, *ERRORS), strict=True):
        for detection, model, style in zip(detections, MODELS, ("-", "--"), strict=False):
            bins = {ends: table for ends, table in detection.by_range.items() if table.classes}
            middles = [sum(ends) / 2 for ends in bins]
            for name, color in colors.items():
                values = [_value(table.classes.get(name), error) for table in bins.values()]
                label = name if model == MODELS[0] else None
                axes.plot(middles, values, style, color=color, linewidth=1, marker=".", label=label, alpha=0.8)
            means = [table.mean_ap if error is None else table.errors[error] for table in bins.values()]
            label = f"mean {model}" if both else "mean"
            axes.plot(middles, means, style, color="black", linewidth=2.5, marker="o", label=label)
        axes.set_title("AP" if error is None else _ERROR_TITLES[error], fontsize=11)
        axes.set_ylim(bottom=0)
        axes.set_xticks(sorted({end for ends in bins for end in ends}))
        axes.grid(color=GRID_COLOR)
    for axes in panels[-1]:
        axes.set_xlabel("distance from the ego vehicle (m)")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False, handlelength=3 if both else None)
    return figure


def _draw_curves(axes: Axes, scores: ClassScores, colors: Sequence[str]) -> None:
    for (distance, curve), color in zip(scores.curves.items(), colors, strict=False):
        reached = curve.score > 0
        axes.plot(RECALLS[reached], curve.precision[reached], color=color, linewidth=2, label=f"{distance:g} m")
    axes.set(xlim=(0, 1), ylim=(0, 1.02))
    axes.grid(color=GRID_COLOR)


def _value(scores: ClassScores | None, error: str | None) -> float:
    """AP (error None) or an error of a class in a bin; NaN without true positives."""
    if scores is None or (error is not None and not scores.recall > 0):
        return np.nan
    return scores.mean_ap if error is None else scores.errors[error]


WORST_FRAMES = 4
MAX_DOTS = 1500
# Colour and style of the outlines, in the order of `Outcome`.
_OUTLINES = {"found": ("#3a9a4b", "-"), "missed": ("#d62728", "-"), "false positive": ("#ff9d1e", "--")}


def draw_bev_sheet(detection: DetectionScores, pairs: FramePairs, name: str = "") -> Figure:
    """Draw all missed ground truths and false positives as dots, and below them the frames with most, as boxes.

    Each class is cut at the score with the largest F1 at the error distance: an application would keep these boxes. The
    vehicle's forward direction is up.
    """
    config = detection.config
    outcomes = {matches.name: best_outcome(matches, config.error_row) for matches in detection.matches}
    threshold = f"largest F1 of each class at {config.error_distance_m:g} m"
    subtitle = f"{name}score threshold: {threshold}; forward is up, rings every 10 m"
    figure = titled_figure((12, 10), "Missed ground truth and false positives, seen from above", subtitle)
    grid = figure.add_gridspec(2, 2 * WORST_FRAMES, height_ratios=(2, 1.15))
    ranges = [boxes.ranges_m for match in detection.matches for boxes in (match.ground_truth, match.predictions)]
    farthest = max((float(values.max()) for values in ranges if len(values)), default=10.0)
    radius = min(10 * np.ceil(farthest / 10), 100.0)
    missed = {name: outcome.missed for name, outcome in outcomes.items()}
    false = {name: outcome.false for name, outcome in outcomes.items()}
    for column, (title, parts) in enumerate((("missed", missed), ("false positives", false))):
        axes = figure.add_subplot(grid[0, column * WORST_FRAMES : (column + 1) * WORST_FRAMES])
        _draw_dots(axes, title, parts, pairs.reference_from_ego, radius)
    mistakes = [boxes.frames for outcome in outcomes.values() for boxes in (outcome.missed, outcome.false)]
    most = Counter(np.concatenate(mistakes).tolist()).most_common(WORST_FRAMES)
    for column, (frame, _) in enumerate(most):
        _draw_frame(figure.add_subplot(grid[1, 2 * column : 2 * column + 2]), frame, outcomes.values(), pairs, radius)
    heading = {"title": "class: missed / false positives", "title_fontsize": 9}
    handles = _legend(missed, false)
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=9, frameon=False, **heading)
    return figure


def _legend(missed: Mapping[str, ScoredBoxes], false: Mapping[str, ScoredBoxes]) -> list[Line2D]:
    colors = plot_colors(missed)
    dots = [
        Line2D([], [], color=colors[name], marker="o", ls="", label=f"{name} {len(boxes)} / {len(false[name])}")
        for name, boxes in missed.items()
    ]
    return dots + [Line2D([], [], color=color, label=label) for label, (color, _) in _OUTLINES.items()]


def _draw_dots(
    axes: Axes, title: str, parts: Mapping[str, ScoredBoxes], reference_from_ego: Array, radius: float
) -> None:
    centers_ego, colors, of_class = [np.zeros((0, 3))], [], plot_colors(parts)
    for name, scored in parts.items():
        ego_from_reference = inverse(reference_from_ego)[scored.frames]
        turned = np.einsum("nij,nj->ni", ego_from_reference[:, :3, :3], scored.boxes.centers)
        centers_ego.append(turned + ego_from_reference[:, :3, 3])
        colors += [of_class[name]] * len(scored)
    points = _in_plot(np.concatenate(centers_ego))
    # A random subset in random order, so that no class hides another.
    shown = np.random.default_rng(0).permutation(len(points))[:MAX_DOTS]
    x, y = points[shown].T
    axes.scatter(x, y, s=16, c=[colors[index] for index in shown], alpha=0.8, linewidths=0, zorder=3)
    _draw_ground(axes, radius)
    thinned = f", {MAX_DOTS} shown" if len(points) > MAX_DOTS else ""
    axes.set_title(f"{len(points)} {title}{thinned}", fontsize=12)


def _draw_frame(axes: Axes, frame: int, outcomes: Iterable[Outcome], pairs: FramePairs, radius: float) -> None:
    ego_from_reference = inverse(pairs.reference_from_ego[frame])
    counts = np.zeros(3, dtype=int)
    for outcome in outcomes:
        parts = [scored[scored.frames == frame] for scored in outcome]
        for scored, (color, style) in zip(parts, _OUTLINES.values(), strict=True):
            outlines = [
                _in_plot(apply(ego_from_reference, corners[[0, 1, 2, 3, 0]])) for corners in scored.boxes.corners()
            ]
            axes.add_collection(LineCollection(outlines, colors=color, linestyles=style, linewidths=1.3, zorder=3))
        counts += [len(scored) for scored in parts]
    _draw_ground(axes, radius)
    stamp = pairs.ground_truth[frame].stamp
    scene = f"{stamp.scene} " if stamp.scene else ""
    axes.set_title(f"{scene}frame {stamp.index}\n{counts[1]} missed, {counts[2]} false positives", fontsize=10)


def _draw_ground(axes: Axes, radius: float) -> None:
    """Range rings every 10 m, and the ego vehicle."""
    for ring in np.arange(10, radius + 1, 10):
        axes.add_patch(Circle((0, 0), ring, fill=False, color="#dddddd", linewidth=0.8, zorder=1))
    ego = np.array([[3.8, 0.0, 0], [2.6, 0.95, 0], [-1.0, 0.95, 0], [-1.0, -0.95, 0], [2.6, -0.95, 0]])
    axes.add_patch(Polygon(_in_plot(ego), color="#333333", zorder=4))
    axes.set(xlim=(-radius, radius), ylim=(-radius, radius), aspect="equal")
    axes.axis("off")


def _in_plot(points_ego: Array) -> Array:
    """Points (N, 3) in the ego frame -> (N, 2) in the plot: x of the ego frame is up, y is left."""
    return np.stack([-points_ego[:, 1], points_ego[:, 0]], axis=-1)
