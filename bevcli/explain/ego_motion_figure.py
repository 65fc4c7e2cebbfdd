"""The figure of the ego-motion inputs: the can-bus numbers, the history shift and the history rotation."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

from bevcli.explain.drawing import ACCENT, FAINT, GREY, INK, SECOND, THIRD, titled_figure, vehicle_outline
from bevcli.explain.trace import Trace

# Name, unit, and how many of the 18 numbers it has.
GROUPS = (
    ("position change x, y, z (world)", "m", 3),
    ("quaternion", "", 4),
    ("acceleration x, y, z", "m/s²", 3),
    ("rotation rate x, y, z", "rad/s", 3),
    ("velocity x, y, z", "m/s", 3),
    ("heading", "rad", 1),
    ("heading change", "°", 1),
)
COLORS = (ACCENT, "#7b3ff2", SECOND, "#b7791f", THIRD, "#c2185b", "#0f766e")


def can_bus(trace: Trace) -> Figure:
    """The 18 can-bus numbers with bars, and the motion of the vehicle that they describe."""
    figure = titled_figure(
        7.9,
        "Ego-motion: the 18 can-bus numbers, the shift and the rotation",
        "Left: the numbers that become one embedding, which is added to every BEV query. Bars are scaled per group.\n"
        "Right: the same motion seen from above. It gives the shift and the rotation of the history map.",
        heading_inches=1.5,
    )
    spec = figure.add_gridspec(1, 2, width_ratios=(1.25, 1), wspace=0.06, left=0.015, right=0.985, bottom=0.075)
    _draw_numbers(figure.add_subplot(spec[0]), trace)
    _draw_motion(figure.add_subplot(spec[1]), trace)
    return figure


def _draw_numbers(axes: Axes, trace: Trace) -> None:
    values = trace.inputs.can_bus[0].cpu().numpy()
    axes.set_xlim(0, 10)
    axes.set_ylim(len(values) + 0.1, -0.6)
    axes.axis("off")
    start = 0
    for place, (name, unit, count) in enumerate(GROUPS):
        group = values[start : start + count]
        largest = max(float(np.abs(group).max()), 1e-9)
        if place % 2 == 0:
            axes.add_patch(Rectangle((0, start - 0.5), 10, count, fc="#f5f6f8", ec="none"))
        if name == "quaternion":
            name += " w, x, y, z" if trace.config.ego_motion.can_bus_quaternion == "wxyz" else " w, w, w, w"
        axes.text(0.75, start + (count - 1) / 2, name, fontsize=12.5, color=INK, va="center")
        for offset, value in enumerate(group):
            row = start + offset
            axes.text(0.15, row, f"{row}", fontsize=10.5, color=GREY, va="center")
            axes.text(
                6.1,
                row,
                f"{round(float(value), 3) + 0.0:.3f}",
                fontsize=12,
                color=INK,
                ha="right",
                va="center",
                family="monospace",
            )
            axes.text(6.25, row, unit, fontsize=11, color=GREY, va="center")
            width = 1.25 * float(value) / largest
            axes.add_patch(Rectangle((8.5, row - 0.3), width, 0.6, fc=COLORS[place], ec="none", alpha=0.85))
        start += count
    axes.plot([8.5, 8.5], [-0.5, len(values) - 0.5], color=GREY, lw=0.8)


def _draw_motion(axes: Axes, trace: Trace) -> None:
    grid = trace.grid
    extent = np.array([grid.x_range_m[1] - grid.x_range_m[0], grid.y_range_m[1] - grid.y_range_m[0]])
    share = trace.inputs.shift[0].cpu().numpy()
    moved, turned = share * extent, float(trace.inputs.rotation_deg[0])
    outline = vehicle_outline(trace.frame)
    angle = np.radians(-turned)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    before = outline @ rotation.T - moved
    reach = max(5.0, float(np.abs(moved).max()) + 3.5)
    axes.set_xlim(-moved[0] / 2 - reach, -moved[0] / 2 + reach)
    axes.set_ylim(-moved[1] / 2 - reach * 1.08, -moved[1] / 2 + reach * 1.08)
    axes.set_aspect("equal")
    _draw_cells(axes, trace)
    axes.add_patch(Polygon(before, fc="none", ec=GREY, lw=1.8, ls="--", zorder=5))
    axes.add_patch(Polygon(outline, fc="#fde3dc", ec=ACCENT, lw=2.2, zorder=4, alpha=0.95))
    if np.hypot(*moved) > 0.05:
        axes.annotate(
            "",
            (0, 0),
            xytext=tuple(-moved),
            zorder=6,
            arrowprops={
                "arrowstyle": "-|>",
                "lw": 2.6,
                "color": SECOND,
                "shrinkA": 0,
                "shrinkB": 0,
                "mutation_scale": 20,
            },
        )
    cells = share * (grid.columns, grid.rows)
    lines = (
        f"shift  ({share[0]:+.4f}, {share[1]:+.4f}) of the map\n"
        f"        = ({moved[0]:+.2f}, {moved[1]:+.2f}) m = ({cells[0]:+.2f}, {cells[1]:+.2f}) cells\n"
        f"rotation  {turned:+.2f}° (counter-clockwise positive)"
    )
    if trace.prediction.started_anew:
        lines = f"no history ({trace.prediction.started_anew}):\nno shift, no rotation"
    axes.text(
        0.03,
        0.03,
        lines,
        transform=axes.transAxes,
        fontsize=12,
        color=INK,
        zorder=9,
        linespacing=1.5,
        bbox={"boxstyle": "round,pad=0.45", "fc": "white", "ec": FAINT},
    )
    axes.set_title("Vehicle: previous frame dashed, current frame solid", fontsize=13, color=INK, loc="left", pad=7)
    axes.tick_params(labelsize=10, colors=GREY, length=3)
    axes.set_xlabel("x, m (bev frame)", fontsize=11, color=GREY)
    for spine in axes.spines.values():
        spine.set_color(FAINT)


def _draw_cells(axes: Axes, trace: Trace) -> None:
    grid = trace.grid
    for low, count, size, draw in (
        (grid.x_range_m[0], grid.columns, grid.cell_size_m[0], axes.axvline),
        (grid.y_range_m[0], grid.rows, grid.cell_size_m[1], axes.axhline),
    ):
        for line in range(count + 1):
            draw(low + line * size, color="#e7e9ee", lw=0.8, zorder=1)
