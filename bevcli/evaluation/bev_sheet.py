"""Misses and false alarms seen from above, around the ego vehicle: all frames together, and the worst ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon

from bevcli.evaluation.operating_point import Outcome, best_outcome
from bevcli.evaluation.plot_style import CLASS_COLORS, titled_figure
from bevcli.evaluation.scored_boxes import ScoredBoxes
from bevcli.evaluation.scoring import Scores
from bevcli.geometry.transforms import Array, apply, inverse

WORST_FRAMES = 4
MOST_DOTS = 1500
_MISS, _ALARM, _HIT = "#d62728", "#ff9d1e", "#3a9a4b"


def draw_bev_sheet(scores: Scores) -> Figure:
    """Above: every miss and every false alarm as a dot. Below: the frames with most of them, box by box.

    Each class is cut at the score that gives its largest F1 at the error distance, so that this shows the boxes
    that one would keep. Ahead is up.
    """
    row = scores.config.distances_m.index(scores.config.error_distance_m)
    outcomes = [best_outcome(matches, row) for matches in scores.detection.matches]
    limit = f"{scores.config.error_distance_m:g} m"
    figure = titled_figure(
        (12, 10),
        "Misses and false alarms, seen from above",
        f"each class is cut at its best score (largest F1 at {limit}); ahead is up, rings every 10 m",
    )
    grid = figure.add_gridspec(2, 2 * WORST_FRAMES, height_ratios=(2, 1.15))
    radius = _radius(scores)
    missed = {outcome.matches.name: outcome.matches.ground_truth[outcome.missed] for outcome in outcomes}
    alarms = {outcome.matches.name: outcome.matches.predictions[outcome.false_alarms] for outcome in outcomes}
    for place, (title, parts) in enumerate((("missed", missed), ("false alarms", alarms))):
        axes = figure.add_subplot(grid[0, place * WORST_FRAMES : (place + 1) * WORST_FRAMES])
        _draw_dots(axes, title, parts, scores.pairs.reference_from_ego, radius)
    for place, frame in enumerate(_worst_frames(outcomes)):
        _draw_frame(figure.add_subplot(grid[1, 2 * place : 2 * place + 2]), frame, outcomes, scores, radius)
    heading = {"title": "class: missed / false alarms", "title_fontsize": 9}
    handles = _legend(missed, alarms)
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=9, frameon=False, **heading)
    return figure


def _legend(missed: Mapping[str, ScoredBoxes], alarms: Mapping[str, ScoredBoxes]) -> list[Line2D]:
    dots = [
        Line2D(
            [],
            [],
            color=CLASS_COLORS[name],
            marker="o",
            linestyle="",
            label=f"{name} {len(part)} / {len(alarms[name])}",
        )
        for name, part in missed.items()
    ]
    outlines = ((_HIT, "found"), (_MISS, "missed"), (_ALARM, "false alarm"))
    return dots + [Line2D([], [], color=color, label=label) for color, label in outlines]


def _radius(scores: Scores) -> float:
    """How far the images reach: the farthest thing that is scored."""
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
    axes: Axes, title: str, parts: Mapping[str, ScoredBoxes], reference_from_ego: Array, radius: float
) -> None:
    places, colors = [np.zeros((0, 3))], []
    for name, part in parts.items():
        ego_from_reference = inverse(reference_from_ego)[part.frames]
        turned = np.einsum("nij,nj->ni", ego_from_reference[:, :3, :3], part.boxes.centers)
        places.append(turned + ego_from_reference[:, :3, 3])
        colors += [CLASS_COLORS[name]] * len(part)
    points = _on_paper(np.concatenate(places))
    # A few of very many, mixed, so that no class hides another.
    shown = np.random.default_rng(0).permutation(len(points))[:MOST_DOTS]
    x, y = points[shown].T
    axes.scatter(x, y, s=16, c=[colors[place] for place in shown], alpha=0.8, linewidths=0, zorder=3)
    _draw_ground(axes, radius)
    thinned = f", {MOST_DOTS} of them shown" if len(points) > MOST_DOTS else ""
    axes.set_title(f"{len(points)} {title}{thinned}", fontsize=12)


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
    stamp = scores.pairs.ground_truth_stamps[frame]
    scene = f"{stamp.scene} " if stamp.scene else ""
    axes.set_title(f"{scene}frame {stamp.index}\n{counts[0]} missed, {counts[1]} false alarms", fontsize=10)


def _draw_boxes(axes: Axes, part: ScoredBoxes, ego_from_reference: Array, color: str, style: str) -> None:
    outlines = [_on_paper(apply(ego_from_reference, corners[:4])) for corners in part.boxes.corners()]
    closed = [np.concatenate([outline, outline[:1]]) for outline in outlines]
    axes.add_collection(LineCollection(closed, colors=color, linestyles=style, linewidths=1.3, zorder=3))


def _draw_ground(axes: Axes, radius: float) -> None:
    """Range rings every 10 m, and the ego vehicle."""
    for ring in np.arange(10, radius + 1, 10):
        axes.add_patch(Circle((0, 0), ring, fill=False, color="#dddddd", linewidth=0.8, zorder=1))
    ego = np.array([[3.8, 0.0, 0], [2.6, 0.95, 0], [-1.0, 0.95, 0], [-1.0, -0.95, 0], [2.6, -0.95, 0]])
    axes.add_patch(Polygon(_on_paper(ego), color="#333333", zorder=4))
    axes.set_xlim(-radius, radius)
    axes.set_ylim(-radius, radius)
    axes.set_aspect("equal")
    axes.axis("off")


def _on_paper(points_ego: Array) -> Array:
    """(N, 3) in the ego frame -> (N, 2): left is left, ahead is up."""
    return np.stack([-points_ego[:, 1], points_ego[:, 0]], axis=-1)
