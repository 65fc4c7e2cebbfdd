"""Figures of the steps in the BEV plane: queries, ego-motion, temporal self-attention, encoder layers, recurrence."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

from bevcli.geometry.transforms import rotation_about_z
from bevcli.workshop.explain import drawing
from bevcli.workshop.explain.drawing import ACCENT, FAINT, GREY, INK, LEAST_SCORE, SECOND, THIRD
from bevcli.workshop.explain.trace import Trace

MOST_LAYERS = 3  # of the encoder: the first, one in the middle, the last


def bev_queries(trace: Trace) -> Figure:
    """The grid with the followed cell, the learned queries, and the position embedding."""
    grid = trace.grid
    channels = trace.bev_embedding.shape[-1]
    size_x, size_y = grid.cell_size_m
    figure = drawing.titled_figure(
        6.3,
        "BEV queries: one learned vector per cell of the grid around the vehicle",
        f"{grid.rows} × {grid.columns} cells of {size_x:.3g} m × {size_y:.3g} m, {channels} channels each. "
        "The square marks the followed cell.\nThe queries are the same in every frame, except for the can-bus "
        "embedding that is added to all of them.",
        heading_inches=1.6,
    )
    spec = figure.add_gridspec(1, 3, wspace=0.14, bottom=0.08)
    index = f"{trace.cell[0]} · {grid.columns} + {trace.cell[1]} = {trace.cell_index}"
    _draw_row_and_column(drawing.bev_panel(figure, spec[0], trace, f"The grid: index {index}"), trace)
    axes = drawing.bev_panel(figure, spec[1], trace, "Learned queries, as colours (PCA)")
    drawing.show_bev(axes, trace, drawing.feature_colors([trace.cell_map(trace.bev_embedding)])[0])
    drawing.mark_cell(axes, trace)
    axes = drawing.bev_panel(figure, spec[2], trace, "Similarity of position embeddings")
    similarity = drawing.cosine_to(trace.cell_map(trace.position), trace.cell)
    image = drawing.show_bev(axes, trace, similarity, cmap="RdBu_r", vmin=-1, vmax=1)
    drawing.mark_cell(axes, trace)
    inset = axes.inset_axes((0.05, 0.05, 0.35, 0.035), zorder=15)
    bar = figure.colorbar(image, cax=inset, orientation="horizontal", ticks=(-1, 0, 1))
    bar.ax.xaxis.set_ticks_position("top")
    bar.ax.tick_params(labelsize=10, colors=INK, length=2)
    return figure


def temporal_attention(trace: Trace) -> Figure | str:
    """The history map before and after the alignment, the current map, and the weight of history per cell."""
    if trace.prediction.started_anew:
        return f"the frame has no history ({trace.prediction.started_anew})"
    assert trace.aligned_history is not None
    assert trace.prediction.attention is not None
    (_, before), (_, now) = trace.recent[-2:]
    assert before.bev is not None
    shift = trace.inputs.shift[0].cpu().numpy() * trace.extent_m
    rotation = float(trace.inputs.rotation_deg[0])
    maps = [trace.cell_map(part) for part in (trace.outputs.bev[0], before.bev, trace.aligned_history)]
    current, history, aligned = drawing.feature_colors(maps)
    aligned[(maps[2] == 0).all(-1)] = 255
    figure = drawing.titled_figure(
        5.3,
        "Temporal self-attention: the previous BEV map, aligned by ego-motion",
        f"The vehicle turned by {rotation:+.1f}° (+ is counter-clockwise) and moved by {shift[0]:+.2f} m in x and "
        f"{shift[1]:+.2f} m in y since the previous frame.\nColours: PCA of the BEV features. Outlines: boxes "
        "predicted in the current frame; dashed: boxes predicted in the previous frame.",
        heading_inches=1.6,
    )
    spec = figure.add_gridspec(1, 4, wspace=0.1, left=0.04, right=0.955, bottom=0.06)
    titles = ("1  Previous map", "2  Rotated and shifted", "3  Current map", "4  Weight of history")
    panels = [drawing.bev_panel(figure, spec[i], trace, title, y_labels=i == 0) for i, title in enumerate(titles)]
    drawing.show_bev(panels[0], trace, history)
    drawing.outline_boxes(panels[0], before.boxes.scored(LEAST_SCORE), INK, style="--", halo=True)
    (x0, x1), (y0, y1) = trace.grid.x_range_m, trace.grid.y_range_m
    moved = (x0 - shift[0], x1 - shift[0], y0 - shift[1], y1 - shift[1])
    panels[1].imshow(aligned, extent=moved, origin="lower", interpolation="nearest", zorder=0)
    panels[1].set(xlim=(x0, x1), ylim=(y0, y1))
    drawing.show_bev(panels[2], trace, current)
    for axes in panels[1:3]:
        drawing.outline_boxes(axes, now.boxes.scored(LEAST_SCORE), INK, halo=True)
    weight = trace.prediction.attention.history_weight
    assert weight is not None
    image = drawing.show_bev(panels[3], trace, weight, cmap="RdBu_r", vmin=0, vmax=1)
    drawing.outline_boxes(panels[3], now.boxes.scored(LEAST_SCORE), INK, width=1.2)
    bounds = panels[3].get_position()
    bar = figure.colorbar(image, cax=figure.add_axes((0.963, bounds.y0 + 0.12, 0.009, 0.44)), ticks=(0, 0.5, 1))
    bar.ax.set_yticklabels(["0 current", "0.5", "1 history"], fontsize=9, color=GREY, rotation=90, va="center")
    return figure


def encoder_layers(trace: Trace) -> Figure:
    """The BEV map as it leaves each encoder layer, and the similarity of its cells to the followed cell."""
    places = sorted({0, len(trace.layer_maps) // 2, len(trace.layer_maps) - 1})[-MOST_LAYERS:]
    query = trace.bev_embedding
    maps = [trace.cell_map(query), *(trace.cell_map(trace.layer_maps[place]) for place in places)]
    colors = [*drawing.feature_colors(maps[:1]), *drawing.feature_colors(maps[1:])]
    titles = ["Before: BEV queries", *(f"After layer {place + 1}" for place in places)]
    boxes = trace.prediction.boxes.scored(LEAST_SCORE)
    figure = drawing.titled_figure(
        8.9,
        "The encoder: empty queries become a map of the surroundings",
        "Top: BEV features as colours (PCA). Bottom: cosine similarity of each cell to the followed cell (square).\n"
        "Outlines: boxes that the decoder predicts from the last map.",
        heading_inches=1.55,
    )
    spec = figure.add_gridspec(2, len(maps), wspace=0.06, hspace=0.16, left=0.05, right=0.95, bottom=0.06)
    for column, (features, image, title) in enumerate(zip(maps, colors, titles, strict=True)):
        top = drawing.bev_panel(figure, spec[0, column], trace, title, y_labels=column == 0)
        drawing.show_bev(top, trace, image)
        bottom = drawing.bev_panel(figure, spec[1, column], trace, "", y_labels=column == 0)
        shown = drawing.show_bev(bottom, trace, drawing.cosine_to(features, trace.cell), cmap="RdBu_r", vmin=-1, vmax=1)
        top.set_xlabel("")
        for axes in (top, bottom):
            drawing.mark_cell(axes, trace)
            if column:
                drawing.outline_boxes(axes, boxes, INK, width=1.0, halo=axes is top)
    drawing.color_bar(figure, shown, (0.958, 0.12, 0.01, 0.24), (-1, 0, 1))
    return figure


def recurrence(trace: Trace) -> Figure | str:
    """The last frames: the front image, the BEV map, and the boxes."""
    if len(trace.recent) == 1:
        return "there is no earlier frame"
    recent = [(frame, prediction) for frame, prediction in trace.recent if prediction.bev is not None]
    colors = drawing.feature_colors([trace.cell_map(p.bev) for _, p in recent if p.bev is not None])
    front = min(trace.frame.rig.cameras, key=lambda camera: abs(camera.yaw)).name
    figure = drawing.titled_figure(
        7.0,
        "The recurrence: each BEV map is the history of the next frame",
        "Top: the front camera. Bottom: BEV features as colours (PCA), with the predicted boxes.\n"
        "The state between two frames is the last BEV map and the pose of the vehicle; nothing else is kept.",
        heading_inches=1.6,
    )
    spec = figure.add_gridspec(
        2, len(recent), height_ratios=(0.6, 1), wspace=0.1, hspace=0.16, left=0.04, right=0.985, bottom=0.06
    )
    for column, ((frame, prediction), image) in enumerate(zip(recent, colors, strict=True)):
        seconds = (frame.stamp.timestamp_ns - trace.frame.stamp.timestamp_ns) / 1e9
        title = f"frame {frame.stamp.index}   t = {seconds:.1f} s"
        drawing.show_camera(figure.add_subplot(spec[0, column]), frame, front, title)
        axes = drawing.bev_panel(figure, spec[1, column], trace, "", y_labels=column == 0)
        drawing.show_bev(axes, trace, image)
        drawing.outline_boxes(axes, prediction.boxes.scored(LEAST_SCORE), INK, halo=True)
        if column:
            props = {"arrowstyle": "simple,head_width=1.1,head_length=0.8", "fc": ACCENT, "ec": "white"}
            axes.annotate("", (0.0, 0.5), (-0.13, 0.5), xycoords="axes fraction", zorder=30, arrowprops=props)
    return figure


def _draw_row_and_column(axes: Axes, trace: Trace) -> None:
    """The lines of the grid, and the row and the column of the followed cell."""
    grid = trace.grid
    drawing.grid_lines(axes, grid, "#dfe2e8", 0.6, most=64)
    x, y = trace.cell_center
    size_x, size_y = grid.cell_size_m
    wide, high = grid.columns * size_x, grid.rows * size_y
    axes.add_patch(Rectangle((grid.x_range_m[0], y - size_y / 2), wide, size_y, fc=SECOND, alpha=0.28, zorder=2))
    axes.add_patch(Rectangle((x - size_x / 2, grid.y_range_m[0]), size_x, high, fc=ACCENT, alpha=0.28, zorder=2))
    drawing.mark_cell(axes, trace)
    right, bottom = grid.x_range_m[1] - 0.02 * wide, grid.y_range_m[0] + 0.04 * high
    labels = (
        (right, y, f"row {trace.cell[0]}", SECOND, "right"),
        (x, bottom, f"column {trace.cell[1]}", ACCENT, "center"),
    )
    for label_x, label_y, text, color, align in labels:
        label = axes.text(label_x, label_y, text, color=color, ha=align, va="center", fontsize=11, fontweight="bold")
        label.set(bbox=drawing.paper(0.2, 0.9), zorder=12)


# Name, unit, how many of the 18 numbers it has, and colour.
GROUPS = (
    ("position change x, y, z (world)", "m", 3, ACCENT),
    ("quaternion", "", 4, "#7b3ff2"),
    ("acceleration x, y, z", "m/s²", 3, SECOND),
    ("rotation rate x, y, z", "rad/s", 3, "#b7791f"),
    ("velocity x, y, z", "m/s", 3, THIRD),
    ("heading", "rad", 1, "#c2185b"),
    ("heading change", "°", 1, "#0f766e"),
)


def can_bus(trace: Trace) -> Figure:
    """The 18 can-bus numbers with bars, and the motion of the vehicle that they describe."""
    figure = drawing.titled_figure(
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
    write = drawing.table_text(axes, -0.6, len(values) + 0.1)
    start = 0
    for place, (name, unit, count, color) in enumerate(GROUPS):
        group = values[start : start + count]
        largest = max(float(np.abs(group).max()), 1e-9)
        if place % 2 == 0:
            axes.add_patch(Rectangle((0, start - 0.5), 10, count, fc="#f5f6f8", ec="none"))
        if name == "quaternion":
            name += " w, x, y, z" if trace.config.ego_motion.can_bus_quaternion == "wxyz" else " w, w, w, w"
        write(0.75, start + (count - 1) / 2, name, fontsize=12.5)
        for offset, value in enumerate(group):
            row = start + offset
            write(0.15, row, f"{row}", fontsize=10.5, color=GREY)
            write(6.1, row, f"{round(float(value), 3) + 0.0:.3f}", ha="right", family="monospace")
            write(6.25, row, unit, fontsize=11, color=GREY)
            width = 1.25 * float(value) / largest
            axes.add_patch(Rectangle((8.5, row - 0.3), width, 0.6, fc=color, ec="none", alpha=0.85))
        start += count
    axes.plot([8.5, 8.5], [-0.5, len(values) - 0.5], color=GREY, lw=0.8)


def _draw_motion(axes: Axes, trace: Trace) -> None:
    share = trace.inputs.shift[0].cpu().numpy()
    moved, turned = share * trace.extent_m, float(trace.inputs.rotation_deg[0])
    outline = drawing.vehicle_outline(trace.frame)
    before = outline @ rotation_about_z(np.radians(-turned))[:2, :2].T - moved
    reach = max(5.0, float(np.abs(moved).max()) + 3.5)
    (x, y), high = -moved / 2, reach * 1.08
    axes.set(xlim=(x - reach, x + reach), ylim=(y - high, y + high), aspect="equal")
    drawing.grid_lines(axes, trace.grid, "#e7e9ee", 0.8)
    axes.add_patch(Polygon(before, fc="none", ec=GREY, lw=1.8, ls="--", zorder=5))
    axes.add_patch(Polygon(outline, fc="#fde3dc", ec=ACCENT, lw=2.2, zorder=4, alpha=0.95))
    if np.hypot(*moved) > 0.05:
        drawing.arrow(axes, -moved, (0, 0), 2.6, size=20, zorder=6)
    cells = share * (trace.grid.columns, trace.grid.rows)
    lines = (
        f"shift  ({share[0]:+.4f}, {share[1]:+.4f}) of the map\n"
        f"        = ({moved[0]:+.2f}, {moved[1]:+.2f}) m = ({cells[0]:+.2f}, {cells[1]:+.2f}) cells\n"
        f"rotation  {turned:+.2f}° (counter-clockwise positive)"
    )
    if trace.prediction.started_anew:
        lines = f"no history ({trace.prediction.started_anew}):\nno shift, no rotation"
    text = axes.text(0.03, 0.03, lines, transform=axes.transAxes, fontsize=12, color=INK, zorder=9, linespacing=1.5)
    text.set_bbox({"boxstyle": "round,pad=0.45", "fc": "white", "ec": FAINT})
    axes.set_title("Vehicle: previous frame dashed, current frame solid", fontsize=13, color=INK, loc="left", pad=7)
    axes.tick_params(labelsize=10, colors=GREY, length=3)
    axes.set_xlabel("x, m (bev frame)", fontsize=11, color=GREY)
    axes.spines[:].set_color(FAINT)
