"""The overview: the whole model as a flow from images to boxes, with this frame's own results as images."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from numpy.typing import NDArray

from bevcli.explain.drawing import (
    ACCENT,
    GREY,
    INK,
    SECOND,
    bare,
    bev_axes,
    confident,
    feature_colors,
    outline_boxes,
    rgb_image,
    show_bev,
    titled_figure,
)
from bevcli.explain.head_figures import map_image
from bevcli.explain.trace import Trace

HEIGHT = 7.7  # inches
MOST_CAMERAS = 6
BLOCK = "#e3eefb"  # fill of a learned part


def overview(trace: Trace) -> Figure:
    """All steps of one frame."""
    figure = titled_figure(
        HEIGHT,
        "BEVFormer: one frame through the model",
        f"Model {trace.config.name}, frame {trace.frame.stamp.index}. Blue: learned parts of the model. "
        "Orange: the recurrent state.",
        heading_inches=1.0,
    )
    canvas = figure.add_axes((0, 0, 1, 1), zorder=0)
    canvas.set_xlim(0, 1)
    canvas.set_ylim(0, 1)
    canvas.axis("off")
    _images_and_features(figure, trace)
    maps = [trace.cell_map(trace.outputs.bev[0])]
    if trace.aligned_history is not None:
        maps.append(trace.cell_map(trace.aligned_history))
    colors = feature_colors(maps)
    _bev(figure, trace, (0.435, 0.645), "BEV queries", feature_colors([trace.cell_map(trace.bev_embedding)])[0])
    if trace.aligned_history is not None:
        image = colors[1]
        image[(maps[1] == 0).all(-1)] = 255
        _bev(figure, trace, (0.435, 0.045), "Previous map, rotated", image)
    _bev(figure, trace, (0.655, 0.29), "BEV map", colors[0], width=0.16)
    _results(figure, trace)
    _flow(canvas, trace)
    return figure


def _images_and_features(figure: Figure, trace: Trace) -> None:
    names = trace.prepared.assignment.cameras[:MOST_CAMERAS]
    lengths = trace.feature_maps[0].norm(dim=1).float().cpu().numpy()
    low, high = np.percentile(lengths, (2, 99.5))
    height, width = trace.prepared.images.shape[-2:]
    for place, name in enumerate(names):
        bottom = 0.79 - 0.127 * (place + 1)
        camera = trace.frame.rig[name]
        axes = figure.add_axes((0.012, bottom, 0.125, 0.118))
        image = rgb_image(trace.frame, name)
        axes.imshow(np.full((9, 16, 3), 225, np.uint8) if image is None else image, aspect="auto")
        bare(axes)
        axes = figure.add_axes((0.265, bottom, 0.125, 0.118))
        axes.imshow(lengths[place], extent=(0, width, height, 0), cmap="magma", vmin=low, vmax=high, aspect="auto")
        axes.set_xlim(0, camera.width * trace.prepared.scales[place])
        axes.set_ylim(camera.height * trace.prepared.scales[place], 0)
        bare(axes)
    figure.text(0.012, 0.8, f"{len(trace.frame.rig.cameras)} cameras", fontsize=12.5, color=INK)
    figure.text(0.265, 0.8, "image features", fontsize=12.5, color=INK)


def _bev(
    figure: Figure, trace: Trace, corner: tuple[float, float], title: str, image: NDArray | None, width: float = 0.1
) -> Axes:
    axes = figure.add_axes((*corner, width, width * 14.0 / HEIGHT))
    bev_axes(axes, trace, title, ticks=False)
    axes.title.set_fontsize(12.5)
    if image is not None:
        show_bev(axes, trace, image)
    return axes


def _results(figure: Figure, trace: Trace) -> None:
    axes = _bev(figure, trace, (0.875, 0.56), "Objects", None, width=0.118)
    outline_boxes(axes, confident(trace.prediction.boxes), ACCENT, width=1.3)
    bev_map = trace.prediction.segmentation
    if bev_map is not None:
        axes = _bev(figure, trace, (0.875, 0.145), "Segmentation", None, width=0.118)
        axes.imshow(map_image(bev_map), extent=(*bev_map.x_range_m, *bev_map.y_range_m), zorder=0)
        axes.set_xlim(*trace.grid.x_range_m)
        axes.set_ylim(*trace.grid.y_range_m)


def _flow(canvas: Axes, trace: Trace) -> None:
    config = trace.config
    _block(canvas, (0.157, 0.29, 0.088, 0.19), "ResNet\nbackbone\n+\nFPN neck")
    _block(
        canvas,
        (0.42, 0.335, 0.205, 0.235),
        f"Encoder × {config.encoder.layers}\n\ntemporal self-attention\nspatial cross-attention\nfeed-forward network",
    )
    _arrow(canvas, (0.139, 0.385), (0.155, 0.385))
    _arrow(canvas, (0.247, 0.385), (0.263, 0.385))
    _arrow(canvas, (0.392, 0.45), (0.418, 0.45))
    _arrow(canvas, (0.485, 0.64), (0.485, 0.575))
    _arrow(canvas, (0.627, 0.45), (0.653, 0.45))
    canvas.text(0.548, 0.74, "+ position\n+ can-bus", fontsize=11.5, color=GREY, va="center")
    if trace.aligned_history is not None:
        _arrow(canvas, (0.485, 0.262), (0.485, 0.33), ACCENT)
    else:
        canvas.text(0.485, 0.2, "no history in\nthis frame", fontsize=11.5, color=ACCENT, va="center", ha="center")
    canvas.add_patch(
        FancyArrowPatch(
            (0.715, 0.285),
            (0.542, 0.135),
            connectionstyle="arc3,rad=-0.35",
            arrowstyle="-|>",
            mutation_scale=18,
            lw=2.2,
            color=ACCENT,
            ls="--",
        )
    )
    state = "the state: BEV map and pose,\nkept for the next frame"
    canvas.text(0.63, 0.075, state, fontsize=11.5, color=ACCENT, va="top")
    _block(canvas, (0.778, 0.63, 0.082, 0.115), "Object\ndecoder", 11.5)
    _arrow(canvas, (0.745, 0.615), (0.776, 0.685))
    _arrow(canvas, (0.861, 0.685), (0.873, 0.685))
    if trace.prediction.segmentation is not None:
        _block(canvas, (0.778, 0.175, 0.085, 0.09), "Segmentation\nhead", 11)
        _arrow(canvas, (0.755, 0.285), (0.79, 0.267))
        _arrow(canvas, (0.864, 0.22), (0.873, 0.22))


def _block(canvas: Axes, place: tuple[float, float, float, float], text: str, size: float = 12.5) -> None:
    x, y, width, height = place
    canvas.add_patch(
        FancyBboxPatch((x, y), width, height, boxstyle="round,pad=0,rounding_size=0.012", fc=BLOCK, ec=SECOND, lw=1.6)
    )
    canvas.text(
        x + width / 2, y + height / 2, text, ha="center", va="center", fontsize=size, color=INK, linespacing=1.4
    )


def _arrow(canvas: Axes, start: tuple[float, float], end: tuple[float, float], color: str = GREY) -> None:
    canvas.add_patch(
        FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=17, lw=2, color=color, shrinkA=0, shrinkB=0)
    )
