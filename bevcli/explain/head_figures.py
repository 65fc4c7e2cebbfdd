"""Figures of the heads: the object decoder, one box code, and segmentation."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from bevcli.explain.drawing import (
    ACCENT,
    FAINT,
    GREY,
    INK,
    LEAST_SCORE,
    SECOND,
    THIRD,
    bev_axes,
    confident,
    ground_truth_in_bev,
    outline_boxes,
    show_bev,
    titled_figure,
)
from bevcli.explain.trace import Trace
from bevcli.frame import MAP_CLASSES, BevMap
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.model.bevformer import BEVFormerOutputs
from bevcli.model.box_coding import decode
from bevcli.model.segmentation import STUFF_CLASSES, THING_CLASS

CODE_NAMES = ("cx", "cy", "log w", "log l", "cz", "log h", "sin", "cos", "vx", "vy")
MAP_COLORS = {
    "drivable_road": "#c9ced8",
    "lane_boundary": "#f2a900",
    "pedestrian_crossing": "#5fa3d3",
    "vehicle": "#e4572e",
    "drivable_area": "#dde0d8",
    "divider": "#c77d00",
    "contour": "#1769aa",
}
OTHER_MAP_COLORS = ("#2a9d5c", "#8e5bb5", "#a05a2c", "#d65db1", "#3a3f4b", "#7fb800", "#0aa5a5", "#7d8597")


def decoder(trace: Trace) -> Figure:
    """The reference points of the object queries layer by layer, and the boxes."""
    points = reference_points(trace)  # (L + 1, Q, 2)
    scores = trace.outputs.class_logits[:, 0].float().sigmoid().amax(-1).cpu().numpy()  # (L, Q)
    chosen = np.flatnonzero(scores[-1] >= LEAST_SCORE)
    figure = titled_figure(
        7.35,
        "Object decoder: reference points move to the objects",
        f"{points.shape[1]} object queries, {len(points) - 1} layers. Left: every query starts at a learned place; "
        f"the {len(chosen)} queries with a final score of at least {LEAST_SCORE:g}\nare coloured, the others grey. "
        "Right: the boxes of these queries.",
        heading_inches=1.55,
    )
    spec = figure.add_gridspec(1, 2, wspace=0.1, bottom=0.075)
    axes = figure.add_subplot(spec[0])
    bev_axes(axes, trace, "Reference points from the start to the last layer")
    _draw_paths(axes, points, chosen)
    axes = figure.add_subplot(spec[1])
    _draw_boxes(axes, trace)
    return figure


def box_code(trace: Trace) -> Figure:
    """The ten numbers of one object query, per decoder layer, and the box that they make."""
    codes = trace.outputs.box_codes[:, 0].float().cpu().numpy()  # (L, Q, 10)
    scores = trace.outputs.class_logits[:, 0].float().sigmoid().cpu().numpy()  # (L, Q, classes)
    query = _query_at_cell(trace, codes[-1], scores[-1])
    label = int(scores[-1, query].argmax())
    name = trace.config.classes[label]
    layers = len(codes)
    figure = titled_figure(
        6.1,
        "Box code: ten numbers per object query",
        f"Query {query}, class {name}. Left: its code after each decoder layer, and what the last one means.\n"
        "Right: its box after each layer (dotted to solid) and its reference point at the start (cross).",
        heading_inches=1.5,
    )
    spec = figure.add_gridspec(1, 2, width_ratios=(1.75, 1), wspace=0.09, left=0.015, right=0.985, bottom=0.085)
    axes = figure.add_subplot(spec[0])
    _draw_code_table(axes, codes[:, query], scores[:, query, label], name)
    axes = figure.add_subplot(spec[1])
    center = codes[-1, query, :2]
    bev_axes(axes, trace, "Box after each layer")
    boxes = [_box_of(trace, layer, query) for layer in range(layers)]
    for layer, box in enumerate(boxes):
        last = layer == layers - 1
        outline_boxes(axes, box, ACCENT if last else SECOND, width=2.4 if last else 1.4, style="-" if last else ":")
    truth = ground_truth_in_bev(trace.frame)
    if truth is not None:
        outline_boxes(axes, truth, "#9aa0ab", width=1.2, style="--")
    path = reference_points(trace)[:, query]
    axes.plot(*path.T, "-", color=GREY, lw=1, zorder=5)
    axes.plot(*path[0], "x", color=INK, ms=9, mew=2, zorder=9)
    reach = float(max(8.0, 1.15 * np.abs(path - center).max()))
    axes.set_xlim(center[0] - reach, center[0] + reach)
    axes.set_ylim(center[1] - reach, center[1] + reach)
    handles = [
        axes.plot([], [], ":", color=SECOND, label="earlier layers")[0],
        axes.plot([], [], "-", color=ACCENT, lw=2.4, label="last layer")[0],
    ]
    if truth is not None:
        handles.append(axes.plot([], [], "--", color="#9aa0ab", label="ground truth")[0])
    axes.legend(handles=handles, fontsize=11, loc="lower right", framealpha=0.95).set_zorder(20)
    return figure


def segmentation(trace: Trace) -> Figure:
    """The probability of each map class per BEV cell, the merged map, and the ground truth."""
    assert trace.prediction.segmentation is not None
    assert trace.outputs.segmentation is not None
    grid = trace.grid
    outputs = trace.outputs.segmentation
    masks = outputs.mask_logits[-1, 0].float().sigmoid() * outputs.class_logits[-1, 0].float().sigmoid()[:, None]
    stuff = STUFF_CLASSES
    layers = torch.cat([masks[: len(stuff)], masks[len(stuff) :].amax(0, keepdim=True)])
    shares = layers.cpu().numpy().reshape(-1, grid.rows, grid.columns)
    figure = titled_figure(
        8.9,
        "Segmentation head: each query paints one mask on the BEV grid",
        "Top: mask probability times class probability of the three stuff queries, and the maximum over the "
        f"{len(masks) - len(stuff)} vehicle queries.\nBottom: the merged map of the model, and the ground truth.",
        heading_inches=1.6,
    )
    spec = figure.add_gridspec(1, 4, wspace=0.1, left=0.045, right=0.94, top=0.805, bottom=0.52)
    for column, (name, share) in enumerate(zip((*stuff, THING_CLASS), shares, strict=True)):
        axes = figure.add_subplot(spec[column])
        bev_axes(axes, trace, name.replace("_", " "))
        image = show_bev(axes, trace, share, cmap="magma", vmin=0, vmax=1)
        axes.set_xlabel("")
        if column:
            axes.set_ylabel("")
            axes.set_yticklabels([])
    bar = figure.colorbar(image, cax=figure.add_axes((0.95, 0.55, 0.01, 0.22)), ticks=(0, 0.5, 1))
    bar.ax.tick_params(labelsize=10, colors=GREY)
    lower = figure.add_gridspec(1, 3, wspace=0.1, left=0.045, right=1.06, top=0.445, bottom=0.06)
    shown: list[tuple[str, BevMap | None]] = [
        ("Merged map of the model", trace.prediction.segmentation),
        ("Ground truth", trace.frame.ground_truth_map),
    ]
    for column, (title, bev_map) in enumerate(shown):
        axes = figure.add_subplot(lower[column])
        if bev_map is None:
            axes.axis("off")
            axes.text(0.5, 0.5, "no ground truth map\nin this sequence", ha="center", color=GREY, fontsize=13)
            continue
        bev_axes(axes, trace, title)
        axes.imshow(
            map_image(bev_map), extent=(*bev_map.x_range_m, *bev_map.y_range_m), interpolation="nearest", zorder=0
        )
        axes.set_xlim(*grid.x_range_m)
        axes.set_ylim(*grid.y_range_m)
    axes = figure.add_subplot(lower[2])
    axes.axis("off")
    handles = [Patch(fc=color, label=name.replace("_", " ")) for name, color in map_colors(MAP_CLASSES).items()]
    axes.legend(handles=handles, loc="center left", fontsize=13, frameon=False)
    return figure


def reference_points(trace: Trace) -> Array:
    """(L + 1, Q, 2) x, y of every object query, metres: at the start, then after each decoder layer."""
    grid = trace.grid
    low = np.array([grid.x_range_m[0], grid.y_range_m[0]])
    extent = np.array([grid.x_range_m[1], grid.y_range_m[1]]) - low
    start = trace.first_reference_points[:, :2].float().cpu().numpy() * extent + low
    refined = trace.outputs.box_codes[:, 0, :, :2].float().cpu().numpy()
    return np.concatenate([start[None], refined])


def _draw_paths(axes: Axes, points: Array, chosen: np.ndarray) -> None:
    layers = len(points) - 1
    axes.plot(*points[0].T, "o", color="#b9bec8", ms=4, zorder=2, label="start of a query")
    shades = np.linspace(0.4, 1.0, layers)
    for layer in range(layers):
        lines = np.stack([points[layer, chosen], points[layer + 1, chosen]], axis=1)
        color = (*np.array([228, 87, 46]) / 255, float(shades[layer]))
        axes.add_collection(LineCollection(list(lines), colors=[color], linewidths=2.0, zorder=4))
        axes.plot(
            *points[layer + 1, chosen].T,
            "o",
            color=color,
            ms=4.5 if layer < layers - 1 else 7,
            zorder=5,
            mec="white" if layer == layers - 1 else "none",
            mew=0.8,
            label=f"after layer {layer + 1}",
        )
    axes.plot(
        *points[0, chosen].T, "o", mfc="white", mec=INK, ms=6, mew=1.3, zorder=4, label="start of a coloured query"
    )
    axes.legend(fontsize=10.5, loc="lower right", framealpha=0.95).set_zorder(20)


def _draw_boxes(axes: Axes, trace: Trace) -> None:
    bev_axes(axes, trace, f"Boxes with a score of at least {LEAST_SCORE:g}; arrows: velocity")
    truth = ground_truth_in_bev(trace.frame)
    handles = []
    if truth is not None:
        outline_boxes(axes, truth, "#9aa0ab", width=1.3, style="--")
        handles.append(axes.plot([], [], "--", color="#9aa0ab", label="ground truth")[0])
    boxes = confident(trace.prediction.boxes)
    outline_boxes(axes, boxes, ACCENT, width=2.0)
    handles.append(axes.plot([], [], "-", color=ACCENT, lw=2, label="prediction")[0])
    for center, velocity in zip(boxes.centers[:, :2], boxes.velocities, strict=True):
        if np.hypot(*velocity) > 0.5:
            axes.annotate(
                "",
                tuple(center + velocity),
                xytext=tuple(center),
                zorder=9,
                annotation_clip=True,
                arrowprops={"arrowstyle": "-|>", "color": SECOND, "lw": 1.6, "shrinkA": 0, "shrinkB": 0},
            )
    _label_boxes(axes, boxes, trace.grid)
    axes.legend(handles=handles, fontsize=11, loc="lower right", framealpha=0.95).set_zorder(20)


def _label_boxes(axes: Axes, boxes: Boxes3D, grid: BevGrid) -> None:
    """Class and score beside each box, best first; no label where it would cover another one."""
    assert boxes.scores is not None
    room = np.array([0.19 * (grid.x_range_m[1] - grid.x_range_m[0]), 0.033 * (grid.y_range_m[1] - grid.y_range_m[0])])
    labelled: list[Array] = []
    for center, name, score in zip(boxes.centers[:, :2], boxes.classes, boxes.scores, strict=True):
        place = center + room * (0.1, 0.7)
        if any((np.abs(place - other) < room).all() for other in labelled):
            continue
        labelled.append(place)
        axes.text(
            place[0],
            place[1],
            f"{name.replace('_', ' ')} {score:.2f}",
            fontsize=9,
            color=INK,
            zorder=10,
            clip_on=True,
            bbox={"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.7},
        )


def _query_at_cell(trace: Trace, codes: Array, scores: Array) -> int:
    """The confident query nearest to the followed cell; without one, the best query of all."""
    best = scores.max(-1)
    candidates = np.flatnonzero(best >= LEAST_SCORE)
    if not len(candidates):
        return int(best.argmax())
    distances = np.hypot(*(codes[candidates, :2] - trace.cell_center).T)
    near = candidates[distances < distances.min() + 0.5]
    return int(near[best[near].argmax()])


def _box_of(trace: Trace, layer: int, query: int) -> Boxes3D:
    """The box of one query after one decoder layer."""
    outputs = trace.outputs
    one = BEVFormerOutputs(
        bev=outputs.bev,
        class_logits=outputs.class_logits[layer : layer + 1, :, query : query + 1],
        box_codes=outputs.box_codes[layer : layer + 1, :, query : query + 1],
    )
    return decode(one, trace.config)[0][:1]


def _draw_code_table(axes: Axes, codes: Array, scores: Array, name: str) -> None:
    layers = len(codes)
    shown = sorted({0, layers // 2, layers - 1})
    axes.set_xlim(0, 10)
    axes.set_ylim(11.3, -1.5)
    axes.axis("off")
    columns = np.linspace(2.3, 2.3 + 1.35 * (len(shown) - 1), len(shown))
    for x, layer in zip(columns, shown, strict=True):
        axes.text(x, -1.0, f"layer {layer + 1}", ha="right", fontsize=12, color=GREY, va="center")
    meaning_x = float(columns[-1]) + 0.45
    axes.text(meaning_x, -1.0, "meaning (last layer)", fontsize=12, color=GREY, va="center")
    for row, (code_name, meaning) in enumerate(zip(CODE_NAMES, _meanings(codes[-1]), strict=True)):
        if row % 2 == 0:
            axes.add_patch(Rectangle((0, row - 0.5), 10, 1, fc="#f5f6f8", ec="none"))
        axes.text(0.15, row, code_name, fontsize=12.5, color=INK, va="center", fontweight="bold")
        for x, layer in zip(columns, shown, strict=True):
            axes.text(
                x,
                row,
                f"{codes[layer, row]:+.2f}",
                ha="right",
                va="center",
                fontsize=12,
                family="monospace",
                color=ACCENT if layer == layers - 1 else INK,
            )
        axes.text(meaning_x, row, meaning, fontsize=12, color=INK, va="center")
    axes.plot([0, 10], [9.75, 9.75], color=FAINT)
    axes.text(0.15, 10.4, "score", fontsize=12.5, color=INK, va="center", fontweight="bold")
    for x, layer in zip(columns, shown, strict=True):
        axes.text(
            x, 10.4, f"{scores[layer]:.2f}", ha="right", va="center", fontsize=12, family="monospace", color=THIRD
        )
    axes.text(meaning_x, 10.4, f"sigmoid of the logit of class {name}", fontsize=12, color=INK, va="center")


def _meanings(code: Array) -> list[str]:
    yaw = np.degrees(-np.arctan2(code[6], code[7]) - np.pi / 2)
    yaw = (yaw + 180) % 360 - 180
    width, length, height = np.exp(code[[2, 3, 5]])
    return [
        f"centre at x = {code[0]:.1f} m",
        f"centre at y = {code[1]:.1f} m",
        f"width {width:.2f} m",
        f"length {length:.2f} m",
        f"centre at z = {code[4]:.2f} m",
        f"height {height:.2f} m",
        f"angle from -y, clockwise: yaw = {yaw:.0f}°",
        "the same angle",
        f"velocity in x {code[8]:+.2f} m/s",
        f"velocity in y {code[9]:+.2f} m/s",
    ]


def map_colors(classes: Iterable[str]) -> dict[str, str]:
    """Map class -> colour on a white page. Classes that are not in MAP_COLORS take OTHER_MAP_COLORS, in their order."""
    names = list(classes)
    others = (name for name in names if name not in MAP_COLORS)
    chosen = {**MAP_COLORS, **dict(zip(others, OTHER_MAP_COLORS, strict=False))}
    return {name: chosen[name] for name in names}


def map_image(bev_map: BevMap) -> np.ndarray:
    """(rows, columns, 3) uint8 RGB of a BEV map, rows as in the map; later classes lie on top."""
    image = np.full((*bev_map.cells.shape, 3), 255, np.uint8)
    for name, color in map_colors(bev_map.classes).items():
        image[bev_map.layer(name)] = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    return image
