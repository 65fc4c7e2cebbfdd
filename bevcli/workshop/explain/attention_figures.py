"""Figures of a model that plans: the objects and the lines of the map that its plan, and one object's motion, used."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_hex
from matplotlib.figure import Figure

from bevcli.frame import Plan
from bevcli.geometry.transforms import Array
from bevcli.workshop.explain import drawing, overview
from bevcli.workshop.explain.drawing import ACCENT, FAINT, GREY, INK, SECOND
from bevcli.workshop.explain.trace import Trace

WEIGHT_COLORS = LinearSegmentedColormap.from_list("weight", ["#d3d7de", "#f5b39a", ACCENT, "#6d0f23"])
LISTED = 8  # rows of a table of weights
LEAST = 0.01  # of the largest weight of a scale: lower ones must not look large
SURE = 0.5  # lines with a lower score are dashed
ROW = tuple[float, str, float | None, Array | None]  # weight, name, score, place


def plan_attention(trace: Trace) -> Figure | str:
    """The objects and lines by the planner's attention, and the planned paths."""
    attention = _attention("plan", trace)
    if attention is None:
        return "the frame has no plan"
    plan = next(result for result in trace.prediction.results if isinstance(result, Plan))
    chosen = plan.commands.index(plan.command) if plan.command else None
    told = f"command {plan.command} (thick path)" if plan.command else f"paths of {', '.join(plan.commands)}"
    return _figure(
        trace,
        attention,
        chosen,
        "The plan: objects and map lines that the planner attended to",
        f"Frame {trace.frame.stamp.index}, {told}. One query for the vehicle attends to all objects, then to all lines."
        "\nThe command chooses a path afterwards: the attention is the same for all commands.",
    )


def motion_attention(trace: Trace) -> Figure | str:
    """The objects and lines by the attention of one object, and its futures."""
    attention = _attention("motion", trace)
    if attention is None:
        return "the frame has no motion"
    assert attention.attending is not None
    box = attention.objects[[attention.attending]]
    assert box.scores is not None
    return _figure(
        trace,
        attention,
        attention.best,
        "Motion: objects and map lines that one object attended to",
        f"Frame {trace.frame.stamp.index}, {box.classes[0]} with score {box.scores[0]:.2f} (blue box) and its futures; "
        "the one with the best score is thick.\nWeights are the mean over its modes. It attends to the lines near it "
        'with a score above a threshold, and to an entry "no line".',
    )


def _attention(part: str, trace: Trace) -> Any | None:
    return trace.attentions.get(part) if trace.prediction.results else None


def _figure(trace: Trace, attention: Any, chosen: int | None, title: str, subtitle: str) -> Figure:
    figure = drawing.titled_figure(9.6, title, subtitle, heading_inches=1.6)
    spec = figure.add_gridspec(1, 3, width_ratios=(1, 1, 1.25), wspace=0.24, left=0.045, right=0.985, bottom=0.06)
    sides = (
        ("Objects", attention.object_weights, _draw_objects),
        ("Lines of the map", attention.line_weights, _draw_lines),
    )
    for place, (name, weights, draw) in enumerate(sides):
        axes = drawing.bev_panel(figure, spec[place], trace, f"{name} by weight", y_labels=place == 0)
        most = max(float(weights.max()), LEAST)
        scale = ScalarMappable(Normalize(0, most), WEIGHT_COLORS)
        draw(axes, attention)
        if attention.attending is not None:
            drawing.outline_boxes(axes, attention.objects[[attention.attending]], SECOND, width=2.6, halo=True)
        _draw_paths(axes, attention, chosen)
        bounds = axes.get_position()
        bar = drawing.color_bar(figure, scale, (bounds.x1 + 0.006, bounds.y0 + 0.02, 0.008, 0.22), (0, most / 2, most))
        bar.ax.yaxis.set_major_formatter(lambda weight, _: f"{100 * weight:.1f} %")
    _draw_table(figure.add_subplot(spec[2]), attention)
    note = f"Dashed: lines with a score below {SURE:g}; places in the table: middle points. Blue: paths, a dot a step."
    figure.text(0.045, 0.008, note, fontsize=11, color=GREY)
    return figure


def _draw_objects(axes: Axes, attention: Any) -> None:
    for place in np.argsort(attention.object_weights):  # the largest on top
        color, width = _style(attention.object_weights, place)
        drawing.outline_boxes(axes, attention.objects[[place]], color, width)


def _draw_lines(axes: Axes, attention: Any) -> None:
    scores = attention.lines.scores
    assert scores is not None
    for place in np.argsort(attention.line_weights):
        style = "-" if scores[place] >= SURE else (0, (3, 2))
        color, width = _style(attention.line_weights, place)
        axes.plot(*attention.lines.points[place].T, color=color, lw=width, ls=style, zorder=5)


def _style(weights: Array, place: int) -> tuple[str, float]:
    """Colour and width of the line of a weight."""
    share = float(weights[place] / max(weights.max(), LEAST))
    return str(to_hex(WEIGHT_COLORS(share))), 0.8 + 2.4 * share


def _draw_paths(axes: Axes, attention: Any, chosen: int | None) -> None:
    for place, path in enumerate(attention.paths):
        is_chosen = place == chosen
        width, opacity = (3.4, 1.0) if is_chosen else (1.4, 0.45)
        axes.plot(*path.T, "-o", color=SECOND, lw=width, alpha=opacity, ms=width + 1, zorder=9 + is_chosen)


def _draw_table(axes: Axes, attention: Any) -> None:
    """The largest weights of objects and of lines."""
    boxes, lines = attention.objects, attention.lines
    assert boxes.scores is not None
    assert lines.scores is not None
    objects = zip(attention.object_weights, boxes.classes, boxes.scores, boxes.centers, strict=True)
    middles = [points[len(points) // 2] for points in lines.points]
    of_lines: list[ROW] = list(zip(attention.line_weights, lines.classes, lines.scores, middles, strict=True))
    if attention.no_line:
        of_lines.append((attention.no_line, "no line", None, None))
    _draw_rows(axes, 0.0, "object", list(objects))
    _draw_rows(axes, LISTED + 2.5, "line", of_lines)


def _draw_rows(axes: Axes, top: float, kind: str, rows: list[ROW]) -> None:
    write = drawing.table_text(axes, -1, 2 * (LISTED + 2.5))
    largest = sorted((row for row in rows if row[0] > 0), key=lambda row: -row[0])[:LISTED]
    columns = ((1.6, "weight", "right"), (2.1, kind, "left"), (6.9, "score", "right"), (10, "at x, y in m", "right"))
    for x, name, align in columns:
        write(x, top, name, ha=align, color=GREY)
    axes.plot([0, 10], [top + 0.5, top + 0.5], color=FAINT)
    for place, (weight, name, score, at) in enumerate(largest):
        row = top + place + 1
        write(1.6, row, f"{100 * weight:.1f} %", ha="right", fontweight="bold", color=INK)
        write(2.1, row, str(name).replace("_", " "))
        if score is not None and at is not None:
            write(6.9, row, f"{score:.2f}", ha="right")
            write(10, row, f"{at[0]:+.1f}, {at[1]:+.1f}", ha="right")
    shown = sum(row[0] for row in largest)
    write(0.0, top + len(largest) + 1, f"{len(largest)} of {len(rows)} entries: {100 * shown:.0f} % of the weight",
          color=GREY)  # fmt: skip


FIGURES: dict[str, drawing.Draw] = {"plan-attention": plan_attention, "motion-attention": motion_attention}
ALL_FIGURES = {**overview.FIGURES, **FIGURES}
