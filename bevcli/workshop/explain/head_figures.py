"""Figures of the heads: the object decoder, one box code, and segmentation."""

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from bevcli.frame import MAP_CLASSES
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, inverse
from bevcli.model.box_coding import decode
from bevcli.model.segmentation import STUFF_CLASSES, THING_CLASS
from bevcli.model.step import ModelOutputs
from bevcli.workshop.explain import drawing
from bevcli.workshop.explain.drawing import ACCENT, FAINT, GREY, INK, LEAST_SCORE, PALE, SECOND, THIRD
from bevcli.workshop.explain.trace import Trace

LEAST_VISIBILITY = 0.2  # ground truth below this is not drawn


def decoder(trace: Trace) -> Figure:
    """The reference points of the object queries layer by layer, and the boxes."""
    points = reference_points(trace)  # (L + 1, Q, 2)
    scores = trace.outputs.class_logits[:, 0].float().sigmoid().amax(-1).cpu().numpy()  # (L, Q)
    chosen = np.flatnonzero(scores[-1] >= LEAST_SCORE)
    figure = drawing.titled_figure(
        7.35,
        "Object decoder: reference points move to the objects",
        f"{points.shape[1]} object queries, {len(points) - 1} layers. Left: every query starts at a learned place; "
        f"the {len(chosen)} queries with a final score of at least {LEAST_SCORE:g}\nare coloured, the others grey. "
        "Right: the boxes of these queries.",
    )
    spec = figure.add_gridspec(1, 2, wspace=0.1, bottom=0.075)
    _draw_paths(
        drawing.bev_panel(figure, spec[0], trace, "Reference points from the start to the last layer"), points, chosen
    )
    title = f"Boxes with a score of at least {LEAST_SCORE:g}; arrows: velocity"
    _draw_boxes(drawing.bev_panel(figure, spec[1], trace, title), trace)
    return figure


def box_code(trace: Trace) -> Figure:
    """The ten numbers of one object query, per decoder layer, and the box that they make."""
    codes = trace.outputs.box_codes[:, 0].float().cpu().numpy()  # (L, Q, 10)
    scores = trace.outputs.class_logits[:, 0].float().sigmoid().cpu().numpy()  # (L, Q, classes)
    query = _query_at_cell(trace, codes[-1], scores[-1])
    label = int(scores[-1, query].argmax())
    name = trace.config.classes[label]
    figure = drawing.titled_figure(
        6.1,
        "Box code: ten numbers per object query",
        f"Query {query}, class {name}. Left: its code after each decoder layer, and what the last one means.\n"
        "Right: its box after each layer (dotted to solid) and its reference point at the start (cross).",
        heading_inches=1.5,
    )
    spec = figure.add_gridspec(1, 2, width_ratios=(1.75, 1), wspace=0.09, left=0.015, right=0.985, bottom=0.085)
    _draw_code_table(figure.add_subplot(spec[0]), codes[:, query], scores[:, query, label], name)
    axes = drawing.bev_panel(figure, spec[1], trace, "Box after each layer")
    center = codes[-1, query, :2]
    for layer in range(len(codes) - 1):
        drawing.outline_boxes(axes, _box_of(trace, layer, query), SECOND, width=1.4, style=":")
    drawing.outline_boxes(axes, _box_of(trace, len(codes) - 1, query), ACCENT, width=2.4)
    truth = _draw_truth(axes, trace, width=1.2)
    path = reference_points(trace)[:, query]
    axes.plot(*path.T, "-", color=GREY, lw=1, zorder=5)
    axes.plot(*path[0], "x", color=INK, ms=9, mew=2, zorder=9)
    reach = float(max(8.0, 1.15 * np.abs(path - center).max()))
    axes.set(xlim=(center[0] - reach, center[0] + reach), ylim=(center[1] - reach, center[1] + reach))
    earlier = axes.plot([], [], ":", color=SECOND, label="earlier layers")
    last = axes.plot([], [], "-", color=ACCENT, lw=2.4, label="last layer")
    drawing.legend(axes, [*earlier, *last, *truth])
    return figure


def segmentation(trace: Trace) -> Figure | str:
    """The probability of each map class per BEV cell, the merged map, and the ground truth."""
    grid, outputs = trace.grid, trace.outputs.segmentation
    if outputs is None:
        return f"model {trace.config.name} has no segmentation head"
    masks = outputs.mask_logits[-1, 0].float().sigmoid() * outputs.class_logits[-1, 0].float().sigmoid()[:, None]
    stuff = STUFF_CLASSES
    layers = torch.cat([masks[: len(stuff)], masks[len(stuff) :].amax(0, keepdim=True)])
    shares = layers.cpu().numpy().reshape(-1, grid.rows, grid.columns)
    figure = drawing.titled_figure(
        8.9,
        "Segmentation head: each query paints one mask on the BEV grid",
        "Top: mask probability times class probability of the three stuff queries, and the maximum over the "
        f"{len(masks) - len(stuff)} vehicle queries.\nBottom: the merged map of the model, and the ground truth.",
        heading_inches=1.6,
    )
    spec = figure.add_gridspec(1, 4, wspace=0.1, left=0.045, right=0.94, top=0.805, bottom=0.52)
    for column, (name, share) in enumerate(zip((*stuff, THING_CLASS), shares, strict=True)):
        axes = drawing.bev_panel(figure, spec[column], trace, name.replace("_", " "), y_labels=column == 0)
        image = drawing.show_bev(axes, trace, share, cmap="magma", vmin=0, vmax=1)
        axes.set_xlabel("")
    drawing.color_bar(figure, image, (0.95, 0.55, 0.01, 0.22), (0, 0.5, 1))
    lower = figure.add_gridspec(1, 3, wspace=0.1, left=0.045, right=1.06, top=0.445, bottom=0.06)
    shown = {"Merged map of the model": trace.prediction.segmentation, "Ground truth": trace.frame.ground_truth_map}
    for column, (title, bev_map) in enumerate(shown.items()):
        axes = figure.add_subplot(lower[column])
        if bev_map is None:
            axes.axis("off")
            axes.text(0.5, 0.5, "no ground truth map\nin this sequence", ha="center", color=GREY, fontsize=13)
            continue
        drawing.bev_axes(axes, trace, title)
        drawing.show_map(axes, trace, bev_map, interpolation="nearest")
    axes = figure.add_subplot(lower[2])
    axes.axis("off")
    colors = drawing.page_colors(MAP_CLASSES)
    handles = [Patch(fc=np.array(color) / 255, label=name.replace("_", " ")) for name, color in colors.items()]
    axes.legend(handles=handles, loc="center left", fontsize=13, frameon=False)
    return figure


def reference_points(trace: Trace) -> Array:
    """(L + 1, Q, 2) x, y of every object query, metres: at the start, then after each decoder layer."""
    low = np.array([trace.grid.x_range_m[0], trace.grid.y_range_m[0]])
    start = trace.first_reference_points[:, :2].float().cpu().numpy() * trace.extent_m + low
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
        size, border = (7.0, "white") if layer == layers - 1 else (4.5, "none")
        (dots,) = axes.plot(*points[layer + 1, chosen].T, "o", color=color, ms=size, mec=border, mew=0.8, zorder=5)
        dots.set_label(f"after layer {layer + 1}")
    start = axes.plot(*points[0, chosen].T, "o", mfc="white", mec=INK, ms=6, mew=1.3, zorder=4)
    start[0].set_label("start of a coloured query")
    drawing.legend(axes, size=10.5)


def _draw_boxes(axes: Axes, trace: Trace) -> None:
    handles = _draw_truth(axes, trace, width=1.3)
    boxes = trace.prediction.boxes.scored(LEAST_SCORE)
    drawing.outline_boxes(axes, boxes, ACCENT, width=2.0)
    handles += axes.plot([], [], "-", color=ACCENT, lw=2, label="prediction")
    for center, velocity in zip(boxes.centers[:, :2], boxes.velocities, strict=True):
        if np.hypot(*velocity) > 0.5:
            drawing.arrow(axes, center, center + velocity, 1.6, zorder=9, annotation_clip=True)
    _label_boxes(axes, boxes, trace.extent_m * (0.19, 0.033))
    drawing.legend(axes, handles)


def _draw_truth(axes: Axes, trace: Trace, width: float) -> list[Line2D]:
    """Draws the ground truth, if there is any, without mostly hidden boxes; returns its line for the legend."""
    frame, truth = trace.frame, trace.frame.ground_truth
    if truth is None:
        return []
    if truth.visibilities is not None:
        truth = truth[~(truth.visibilities < LEAST_VISIBILITY)]  # unknown visibility is NaN and stays
    in_bev = truth.transformed(inverse(frame.world_from_ego.matrix @ frame.rig.ego_from_bev))
    drawing.outline_boxes(axes, in_bev, PALE, width=width, style="--")
    return axes.plot([], [], "--", color=PALE, label="ground truth")


def _label_boxes(axes: Axes, boxes: Boxes3D, room: Array) -> None:
    """Class and score beside each box, best first, within the axes; no label where it would cover another one.

    room: (2,) width and height of a label, metres.
    """
    assert boxes.scores is not None
    labelled: list[Array] = []
    last_place = np.array([axes.get_xlim()[1], axes.get_ylim()[1]]) - room
    for center, name, score in zip(boxes.centers[:, :2], boxes.classes, boxes.scores, strict=True):
        place = np.minimum(center + room * (0.1, 0.7), last_place)
        if any((np.abs(place - other) < room).all() for other in labelled):
            continue
        labelled.append(place)
        label = axes.text(place[0], place[1], f"{name.replace('_', ' ')} {score:.2f}", fontsize=9, color=INK)
        label.set(zorder=10, clip_on=True, bbox=drawing.paper(0.1, 0.7))


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
    outputs, of_query = trace.outputs, (slice(layer, layer + 1), slice(None), slice(query, query + 1))
    one = ModelOutputs(outputs.bev, outputs.class_logits[of_query], outputs.box_codes[of_query])
    return decode(one, trace.config)[:1]


def _draw_code_table(axes: Axes, codes: Array, scores: Array, name: str) -> None:
    layers, write = len(codes), drawing.table_text(axes, -1.5, 11.3)
    shown = sorted({0, layers // 2, layers - 1})
    columns = np.linspace(2.3, 2.3 + 1.35 * (len(shown) - 1), len(shown))
    for x, layer in zip(columns, shown, strict=True):
        write(x, -1.0, f"layer {layer + 1}", ha="right", color=GREY)
    meaning_x = float(columns[-1]) + 0.45
    write(meaning_x, -1.0, "meaning (last layer)", color=GREY)
    for row, (code_name, meaning) in enumerate(_meanings(codes[-1]).items()):
        if row % 2 == 0:
            axes.add_patch(Rectangle((0, row - 0.5), 10, 1, fc="#f5f6f8", ec="none"))
        write(0.15, row, code_name, fontsize=12.5, fontweight="bold")
        for x, layer in zip(columns, shown, strict=True):
            color = ACCENT if layer == layers - 1 else INK
            write(x, row, f"{codes[layer, row]:+.2f}", ha="right", family="monospace", color=color)
        write(meaning_x, row, meaning)
    axes.plot([0, 10], [9.75, 9.75], color=FAINT)
    write(0.15, 10.4, "score", fontsize=12.5, fontweight="bold")
    for x, layer in zip(columns, shown, strict=True):
        write(x, 10.4, f"{scores[layer]:.2f}", ha="right", family="monospace", color=THIRD)
    write(meaning_x, 10.4, f"sigmoid of the logit of class {name}")


def _meanings(code: Array) -> dict[str, str]:
    """The name of each number of a box code, and its meaning."""
    yaw = (np.degrees(-np.arctan2(code[6], code[7]) - np.pi / 2) + 180) % 360 - 180
    width, length, height = np.exp(code[[2, 3, 5]])
    return {
        "cx": f"centre at x = {code[0]:.1f} m",
        "cy": f"centre at y = {code[1]:.1f} m",
        "log w": f"width {width:.2f} m",
        "log l": f"length {length:.2f} m",
        "cz": f"centre at z = {code[4]:.2f} m",
        "log h": f"height {height:.2f} m",
        "sin": f"angle from -y, clockwise: yaw = {yaw:.0f}°",
        "cos": "the same angle",
        "vx": f"velocity in x {code[8]:+.2f} m/s",
        "vy": f"velocity in y {code[9]:+.2f} m/s",
    }
