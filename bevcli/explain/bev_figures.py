"""Figures of the steps in the BEV plane: queries, temporal self-attention, encoder layers, recurrence."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle

from bevcli.explain.drawing import (
    ACCENT,
    GREY,
    INK,
    SECOND,
    bev_axes,
    confident,
    cosine_to,
    feature_colors,
    mark_cell,
    outline_boxes,
    show_bev,
    show_camera,
    titled_figure,
)
from bevcli.explain.trace import Trace

MOST_LAYERS = 3  # of the encoder: the first, one in the middle, the last


def bev_queries(trace: Trace) -> Figure:
    """The grid with the followed cell, the learned queries, and the position embedding."""
    grid = trace.grid
    channels = trace.bev_embedding.shape[-1]
    size_x, size_y = grid.cell_size_m
    figure = titled_figure(
        6.3,
        "BEV queries: one learned vector per cell of the grid around the vehicle",
        f"{grid.rows} × {grid.columns} cells of {size_x:.3g} m × {size_y:.3g} m, {channels} channels each. "
        "The square marks the followed cell.\nThe queries are the same in every frame, except for the can-bus "
        "embedding that is added to all of them.",
        heading_inches=1.6,
    )
    spec = figure.add_gridspec(1, 3, wspace=0.14, bottom=0.08)
    axes = figure.add_subplot(spec[0])
    bev_axes(axes, trace, f"The grid: index {trace.cell[0]} · {grid.columns} + {trace.cell[1]} = {trace.cell_index}")
    _draw_grid_lines(axes, trace)
    axes = figure.add_subplot(spec[1])
    bev_axes(axes, trace, "Learned queries, as colours (PCA)")
    show_bev(axes, trace, feature_colors([trace.cell_map(trace.bev_embedding)])[0])
    mark_cell(axes, trace, least_m=1.5)
    axes = figure.add_subplot(spec[2])
    bev_axes(axes, trace, "Similarity of position embeddings")
    similarity = cosine_to(trace.cell_map(trace.position), trace.cell)
    image = show_bev(axes, trace, similarity, cmap="RdBu_r", vmin=-1, vmax=1)
    mark_cell(axes, trace, least_m=1.5)
    _inner_bar(axes, image, (-1, 0, 1))
    return figure


def temporal_attention(trace: Trace) -> Figure:
    """The history map before and after the alignment, the current map, and the weight of history per cell."""
    assert trace.aligned_history is not None
    assert trace.prediction.attention is not None
    (_, before), (_, now) = trace.recent[-2:]
    assert before.bev is not None
    shift = trace.inputs.shift[0].cpu().numpy() * _extent(trace)
    rotation = float(trace.inputs.rotation_deg[0])
    maps = feature_colors([trace.cell_map(part) for part in (trace.outputs.bev[0], before.bev, trace.aligned_history)])
    current, history, aligned = maps
    aligned[(trace.cell_map(trace.aligned_history) == 0).all(-1)] = 255
    figure = titled_figure(
        5.3,
        "Temporal self-attention: the previous BEV map, aligned by ego-motion",
        f"The vehicle turned by {rotation:+.1f}° (+ is counter-clockwise) and moved by {shift[0]:+.2f} m in x and "
        f"{shift[1]:+.2f} m in y since the previous frame.\nColours: PCA of the BEV features. Outlines: boxes "
        "predicted in the current frame; dashed: boxes predicted in the previous frame.",
        heading_inches=1.6,
    )
    spec = figure.add_gridspec(1, 4, wspace=0.1, left=0.04, right=0.955, bottom=0.06)
    panels = [figure.add_subplot(spec[i]) for i in range(4)]
    titles = ("1  Previous map", "2  Rotated and shifted", "3  Current map", "4  Weight of history")
    for axes, title in zip(panels, titles, strict=True):
        bev_axes(axes, trace, title)
        if axes is not panels[0]:
            axes.set_ylabel("")
            axes.set_yticklabels([])
    show_bev(panels[0], trace, history)
    outline_boxes(panels[0], confident(before.boxes), INK, style="--", halo=True)
    (x0, x1), (y0, y1) = trace.grid.x_range_m, trace.grid.y_range_m
    moved = (x0 - shift[0], x1 - shift[0], y0 - shift[1], y1 - shift[1])
    panels[1].imshow(aligned, extent=moved, origin="lower", interpolation="nearest", zorder=0)
    panels[1].set_xlim(x0, x1)
    panels[1].set_ylim(y0, y1)
    show_bev(panels[2], trace, current)
    for axes in panels[1:3]:
        outline_boxes(axes, confident(now.boxes), INK, halo=True)
    weight = trace.prediction.attention.history_weight
    assert weight is not None
    image = show_bev(panels[3], trace, weight, cmap="RdBu_r", vmin=0, vmax=1)
    outline_boxes(panels[3], confident(now.boxes), INK, width=1.2)
    bounds = panels[3].get_position()
    bar = figure.colorbar(image, cax=figure.add_axes((0.963, bounds.y0 + 0.12, 0.009, 0.44)), ticks=(0, 0.5, 1))
    bar.ax.set_yticklabels(["0 current", "0.5", "1 history"], fontsize=9, color=GREY, rotation=90, va="center")
    return figure


def encoder_layers(trace: Trace) -> Figure:
    """The BEV map as it leaves each encoder layer, and the similarity of its cells to the followed cell."""
    places = sorted({0, len(trace.layer_maps) // 2, len(trace.layer_maps) - 1})[-MOST_LAYERS:]
    query = trace.bev_embedding
    maps = [trace.cell_map(query), *(trace.cell_map(trace.layer_maps[place]) for place in places)]
    colors = [*feature_colors(maps[:1]), *feature_colors(maps[1:])]
    titles = ["Before: BEV queries", *(f"After layer {place + 1}" for place in places)]
    boxes = confident(trace.prediction.boxes)
    figure = titled_figure(
        8.9,
        "The encoder: empty queries become a map of the surroundings",
        "Top: BEV features as colours (PCA). Bottom: cosine similarity of each cell to the followed cell (square).\n"
        "Outlines: boxes that the decoder predicts from the last map.",
        heading_inches=1.55,
    )
    spec = figure.add_gridspec(2, len(maps), wspace=0.06, hspace=0.16, left=0.05, right=0.95, bottom=0.06)
    for column, (features, image, title) in enumerate(zip(maps, colors, titles, strict=True)):
        top, bottom = (figure.add_subplot(spec[row, column]) for row in range(2))
        bev_axes(top, trace, title)
        show_bev(top, trace, image)
        bev_axes(bottom, trace, "")
        shown = show_bev(bottom, trace, cosine_to(features, trace.cell), cmap="RdBu_r", vmin=-1, vmax=1)
        top.set_xlabel("")
        for axes in (top, bottom):
            mark_cell(axes, trace, least_m=1.5)
            if column:
                outline_boxes(axes, boxes, INK, width=1.0, halo=axes is top)
                axes.set_ylabel("")
                axes.set_yticklabels([])
    bar = figure.colorbar(shown, cax=figure.add_axes((0.958, 0.12, 0.01, 0.24)), ticks=(-1, 0, 1))
    bar.ax.tick_params(labelsize=10, colors=GREY)
    return figure


def recurrence(trace: Trace) -> Figure:
    """The last frames: the front image, the BEV map, and the boxes."""
    recent = [(frame, prediction) for frame, prediction in trace.recent if prediction.bev is not None]
    colors = feature_colors([trace.cell_map(p.bev) for _, p in recent if p.bev is not None])
    front = min(trace.frame.rig.cameras, key=lambda camera: abs(camera.yaw)).name
    figure = titled_figure(
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
        show_camera(
            figure.add_subplot(spec[0, column]), frame, front, f"frame {frame.stamp.index}   t = {seconds:.1f} s"
        )
        axes = figure.add_subplot(spec[1, column])
        bev_axes(axes, trace, "")
        show_bev(axes, trace, image)
        outline_boxes(axes, confident(prediction.boxes), INK, halo=True)
        if column:
            axes.set_ylabel("")
            axes.set_yticklabels([])
            axes.annotate(
                "",
                (0.0, 0.5),
                xytext=(-0.13, 0.5),
                xycoords="axes fraction",
                zorder=30,
                arrowprops={"arrowstyle": "simple,head_width=1.1,head_length=0.8", "fc": ACCENT, "ec": "white"},
            )
    return figure


def _draw_grid_lines(axes: Axes, trace: Trace) -> None:
    grid = trace.grid
    for low, cells, size, draw in (
        (grid.x_range_m[0], grid.columns, grid.cell_size_m[0], axes.axvline),
        (grid.y_range_m[0], grid.rows, grid.cell_size_m[1], axes.axhline),
    ):
        step = max(1, cells // 64)
        for line in range(0, cells + 1, step):
            draw(low + line * size, color="#dfe2e8", lw=0.6, zorder=1)
    x, y = trace.cell_center
    size_x, size_y = grid.cell_size_m
    wide, high = grid.columns * size_x, grid.rows * size_y
    axes.add_patch(Rectangle((grid.x_range_m[0], y - size_y / 2), wide, size_y, fc=SECOND, alpha=0.28, zorder=2))
    axes.add_patch(Rectangle((x - size_x / 2, grid.y_range_m[0]), size_x, high, fc=ACCENT, alpha=0.28, zorder=2))
    mark_cell(axes, trace, least_m=1.5)
    right, bottom = grid.x_range_m[1] - 0.02 * wide, grid.y_range_m[0] + 0.04 * high
    labels = (
        (right, y, f"row {trace.cell[0]}", SECOND, "right"),
        (x, bottom, f"column {trace.cell[1]}", ACCENT, "center"),
    )
    for label_x, label_y, text, color, align in labels:
        label = axes.text(label_x, label_y, text, color=color, ha=align, va="center", fontsize=11, fontweight="bold")
        label.set_bbox({"boxstyle": "round,pad=0.2", "fc": "white", "ec": "none", "alpha": 0.9})
        label.set_zorder(12)


def _inner_bar(axes: Axes, image: AxesImage, ticks: tuple[float, ...]) -> None:
    inset = axes.inset_axes((0.05, 0.05, 0.35, 0.035), zorder=15)
    bar = axes.figure.colorbar(image, cax=inset, orientation="horizontal", ticks=ticks)
    bar.ax.xaxis.set_ticks_position("top")
    bar.ax.tick_params(labelsize=10, colors=INK, length=2)


def _extent(trace: Trace) -> np.ndarray:
    grid = trace.grid
    return np.array([grid.x_range_m[1] - grid.x_range_m[0], grid.y_range_m[1] - grid.y_range_m[0]])
