"""Misses and false alarms seen from above, around the ego vehicle: all frames together, and the worst ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon
from numpy.typing import NDArray

from bevcli.evaluation.operating_point import Outcome, best_outcome
from bevcli.evaluation.plot_style import CLASS_COLORS, titled_figure
from bevcli.evaluation.scored_boxes import ScoredBoxes
from bevcli.evaluation.scoring import Scores
from bevcli.geometry.transforms import Array, apply, inverse

WORST_FRAMES = 4
_MISS, _ALARM, _HIT = "#d62728", "#ff9d1e", "#3a9a4b"


def draw_bev_sheet(scores: Scores) -> Figure:
    """Above: every miss and every false alarm as a dot. Below: the frames with most of them, box by box.

    Each class is cut at the score that gives its largest F1 at the error distance, so that this shows the boxes
    that one would keep. Ahead is up.
    """
    row = scores.config.distances_m.index(scores.config.error_distance_m)
    outcomes = [best_outcome(matches, row) for matches in scores.detection.matches]
    missed, alarms = (sum(int(flags.sum()) for flags in side) for side in _sides(outcomes))
    figure = titled_figure(
        (14, 11.5),
        "Misses and false alarms, seen from above",
        f"{missed} missed, {alarms} false alarms; each class cut at its best score (largest F1 at "
        f"{scores.config.error_distance_m:g} m); ahead is up",
    )
    grid = figure.add_gridspec(3, WORST_FRAMES)
    radius = _radius(scores)
    half = WORST_FRAMES // 2
    everything = (
        ("All misses", [(o.matches.name, o.matches.ground_truth[o.missed]) for o in outcomes]),
        ("All false alarms", [(o.matches.name, o.matches.predictions[o.false_alarms]) for o in outcomes]),
    )
    for place, (title, parts) in enumerate(everything):
        axes = figure.add_subplot(grid[:2, place * half : (place + 1) * half])
        _draw_dots(axes, title, parts, scores.pairs.reference_from_ego, radius)
    for place, frame in enumerate(_worst_frames(outcomes)):
        _draw_frame(figure.add_subplot(grid[2, place]), frame, outcomes, scores, radius)
    return figure


def _sides(outcomes: list[Outcome]) -> tuple[list[NDArray[np.bool_]], list[NDArray[np.bool_]]]:
    return [outcome.missed for outcome in outcomes], [outcome.false_alarms for outcome in outcomes]


def _radius(scores: Scores) -> float:
    """How far the pictures reach: the farthest thing that is scored."""
    ranges = [part.ranges_m for match in scores.detection.matches for part in (match.ground_truth, match.predictions)]
    farthest = max((float(values.max()) for values in ranges if len(values)), default=10.0)
    return min(10 * np.ceil(farthest / 10), 100.0)


def _worst_frames(outcomes: list[Outcome]) -> list[int]:
    counts: Counter[int] = Counter()
    for outcome in outcomes:
        counts.update(outcome.matches.ground_truth.frames[outcome.missed].tolist())
        counts.update(outcome.matches.predictions.frames[outcome.false_alarms].tolist())
    return [frame for frame, _ in counts.most_common(WORST_FRAMES)]


def _draw_dots(
    axes: Axes, title: str, parts: Iterable[tuple[str, ScoredBoxes]], reference_from_ego: Array, radius: float
) -> None:
    total = 0
    for name, part in parts:
        ego_from_reference = inverse(reference_from_ego)[part.frames]
        points = np.einsum("nij,nj->ni", ego_from_reference[:, :3, :3], part.boxes.centers)
        points += ego_from_reference[:, :3, 3]
        size = 22 if len(part) < 200 else 6
        x, y = _on_paper(points).T
        label = f"{name} ({len(part)})"
        axes.scatter(x, y, s=size, color=CLASS_COLORS[name], label=label, alpha=0.75, linewidths=0, zorder=3)
        total += len(part)
    _draw_ground(axes, radius)
    axes.set_title(f"{title}: {total}", fontsize=12)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)


def _draw_frame(axes: Axes, frame: int, outcomes: list[Outcome], scores: Scores, radius: float) -> None:
    ego_from_reference = inverse(scores.pairs.reference_from_ego[frame])
    counts = [0, 0]
    for outcome in outcomes:
        truth, found = outcome.matches.ground_truth, outcome.matches.predictions
        here, said_here = truth.frames == frame, found.frames == frame
        _draw_boxes(axes, truth[here & ~outcome.missed], ego_from_reference, _HIT, "-")
        _draw_boxes(axes, truth[here & outcome.missed], ego_from_reference, _MISS, "-")
        _draw_boxes(axes, found[said_here & outcome.false_alarms], ego_from_reference, _ALARM, "--")
        counts[0] += int((here & outcome.missed).sum())
        counts[1] += int((said_here & outcome.false_alarms).sum())
    _draw_ground(axes, radius)
    stamp = scores.pairs.prediction_stamps[frame]
    scene = f"{stamp.scene} " if stamp.scene else ""
    axes.set_title(f"{scene}frame {stamp.index}: {counts[0]} missed, {counts[1]} false", fontsize=10)
    styles = ((_HIT, "found"), (_MISS, "missed"), (_ALARM, "false alarm"))
    handles = [Line2D([], [], color=color, label=label) for color, label in styles]
    axes.legend(handles=handles, loc="lower left", fontsize=7, framealpha=0.8)


def _draw_boxes(axes: Axes, part: ScoredBoxes, ego_from_reference: Array, color: str, style: str) -> None:
    outlines = [_on_paper(apply(ego_from_reference, corners[:4])) for corners in part.boxes.corners()]
    closed = [np.concatenate([outline, outline[:1]]) for outline in outlines]
    axes.add_collection(LineCollection(closed, colors=color, linestyles=style, linewidths=1.3, zorder=3))


def _draw_ground(axes: Axes, radius: float) -> None:
    """Range rings every 10 m, and the ego vehicle."""
    for ring in np.arange(10, radius + 1, 10):
        axes.add_patch(Circle((0, 0), ring, fill=False, color="#dddddd", linewidth=0.8, zorder=1))
        axes.text(0, -ring, f"{ring:.0f} m", fontsize=7, color="#999999", ha="center", va="bottom", zorder=2)
    ego = np.array([[3.8, 0.0, 0], [2.6, 0.95, 0], [-1.0, 0.95, 0], [-1.0, -0.95, 0], [2.6, -0.95, 0]])
    axes.add_patch(Polygon(_on_paper(ego), color="#333333", zorder=4))
    axes.set_xlim(-radius, radius)
    axes.set_ylim(-radius, radius)
    axes.set_aspect("equal")
    axes.axis("off")


def _on_paper(points_ego: Array) -> Array:
    """(N, 3) in the ego frame -> (N, 2): left is left, ahead is up."""
    return np.stack([-points_ego[:, 1], points_ego[:, 0]], axis=-1)
