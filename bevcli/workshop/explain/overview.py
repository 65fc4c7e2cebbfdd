"""The overview of BEVFormer, and the list of its figures."""

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from numpy.typing import NDArray

from bevcli.printing import counted
from bevcli.workshop.explain import drawing
from bevcli.workshop.explain.bev_figures import bev_queries, can_bus, encoder_layers, recurrence, temporal_attention
from bevcli.workshop.explain.camera_figures import image_features, pillars, spatial_attention
from bevcli.workshop.explain.drawing import ACCENT, GREY, INK, LEAST_SCORE, SECOND
from bevcli.workshop.explain.head_figures import box_code, decoder, segmentation
from bevcli.workshop.explain.trace import Trace

HEIGHT = 7.7  # inches
MOST_CAMERAS = 6
BLOCK = "#e3eefb"  # fill of a learned part
# Arrows of every model: images, backbone, features, encoder, queries, BEV map, decoder, boxes.
FLOW = (
    ((0.139, 0.385), (0.155, 0.385)), ((0.247, 0.385), (0.263, 0.385)), ((0.392, 0.45), (0.418, 0.45)),
    ((0.485, 0.64), (0.485, 0.575)), ((0.627, 0.45), (0.653, 0.45)), ((0.745, 0.615), (0.776, 0.685)),
    ((0.861, 0.685), (0.873, 0.685)),
)  # fmt: skip


def overview(trace: Trace) -> Figure:
    """All steps of one frame."""
    figure = drawing.titled_figure(
        HEIGHT,
        "BEVFormer: one frame through the model",
        f"Model {trace.config.name}, frame {trace.frame.stamp.index}. Blue: learned parts of the model. "
        "Orange: the recurrent state.",
        heading_inches=1.0,
    )
    canvas = figure.add_axes((0, 0, 1, 1), zorder=0)
    canvas.set(xlim=(0, 1), ylim=(0, 1))
    canvas.axis("off")
    _images_and_features(figure, trace)
    maps = [trace.cell_map(trace.outputs.bev[0])]
    if trace.aligned_history is not None:
        maps.append(trace.cell_map(trace.aligned_history))
    colors = drawing.feature_colors(maps)
    _bev(figure, trace, (0.435, 0.645), "BEV queries", drawing.feature_colors([trace.cell_map(trace.bev_embedding)])[0])
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
    for place, name in enumerate(names):
        bottom = 0.79 - 0.127 * (place + 1)
        axes = figure.add_axes((0.012, bottom, 0.125, 0.118))
        axes.imshow(drawing.rgb_image(trace.frame, name), aspect="auto")
        drawing.bare(axes)
        drawing.show_lengths(figure.add_axes((0.265, bottom, 0.125, 0.118)), trace, lengths, place, aspect="auto")
    figure.text(0.012, 0.8, counted(len(trace.frame.rig.cameras), "cameras"), fontsize=12.5, color=INK)
    figure.text(0.265, 0.8, "image features", fontsize=12.5, color=INK)


def _bev(
    figure: Figure, trace: Trace, corner: tuple[float, float], title: str, image: NDArray | None, width: float = 0.1
) -> Axes:
    axes = figure.add_axes((*corner, width, width * 14.0 / HEIGHT))
    drawing.bev_axes(axes, trace, title, ticks=False)
    axes.title.set_fontsize(12.5)
    if image is not None:
        drawing.show_bev(axes, trace, image)
    return axes


def _results(figure: Figure, trace: Trace) -> None:
    axes = _bev(figure, trace, (0.875, 0.56), "Objects", None, width=0.118)
    drawing.outline_boxes(axes, trace.prediction.boxes.scored(LEAST_SCORE), ACCENT, width=1.3)
    bev_map = trace.prediction.segmentation
    if bev_map is not None:
        axes = _bev(figure, trace, (0.875, 0.145), "Segmentation", None, width=0.118)
        drawing.show_map(axes, trace, bev_map)


def _flow(canvas: Axes, trace: Trace) -> None:
    _block(canvas, (0.157, 0.29, 0.088, 0.19), f"{trace.config.backbone.title}\nbackbone\n+\nFPN neck")
    parts = "temporal self-attention\nspatial cross-attention\nfeed-forward network"
    _block(canvas, (0.42, 0.335, 0.205, 0.235), f"Encoder × {trace.config.encoder.layers}\n\n{parts}")
    _block(canvas, (0.778, 0.63, 0.082, 0.115), "Object\ndecoder", 11.5)
    for start, end in FLOW:
        _arrow(canvas, start, end)
    canvas.text(0.548, 0.74, "+ position\n+ can-bus", fontsize=11.5, color=GREY, va="center")
    if trace.aligned_history is not None:
        _arrow(canvas, (0.485, 0.262), (0.485, 0.33), ACCENT)
    else:
        canvas.text(0.485, 0.2, "no history in\nthis frame", fontsize=11.5, color=ACCENT, va="center", ha="center")
    curve: dict[str, Any] = {"connectionstyle": "arc3,rad=-0.35", "lw": 2.2, "ls": "--", "mutation_scale": 18}
    canvas.add_patch(FancyArrowPatch((0.715, 0.285), (0.542, 0.135), arrowstyle="-|>", color=ACCENT, **curve))
    state = "the state: BEV map and pose,\nkept for the next frame"
    canvas.text(0.63, 0.075, state, fontsize=11.5, color=ACCENT, va="top")
    if trace.prediction.segmentation is not None:
        _block(canvas, (0.778, 0.175, 0.085, 0.09), "Segmentation\nhead", 11)
        _arrow(canvas, (0.755, 0.285), (0.79, 0.267))
        _arrow(canvas, (0.864, 0.22), (0.873, 0.22))


def _block(canvas: Axes, place: drawing.Rect, text: str, size: float = 12.5) -> None:
    x, y, width, height = place
    style = "round,pad=0,rounding_size=0.012"
    canvas.add_patch(FancyBboxPatch((x, y), width, height, boxstyle=style, fc=BLOCK, ec=SECOND, lw=1.6))
    label = canvas.text(x + width / 2, y + height / 2, text, ha="center", va="center", fontsize=size, color=INK)
    label.set_linespacing(1.4)


def _arrow(canvas: Axes, start: tuple[float, float], end: tuple[float, float], color: str = GREY) -> None:
    style: dict[str, Any] = {"arrowstyle": "-|>", "mutation_scale": 17, "lw": 2, "shrinkA": 0, "shrinkB": 0}
    canvas.add_patch(FancyArrowPatch(start, end, color=color, **style))


# In the order of the model.
FIGURES: dict[str, drawing.Draw] = {
    "overview": overview,
    "image-features": image_features,
    "bev-queries": bev_queries,
    "can-bus": can_bus,
    "pillars": pillars,
    "spatial-attention": spatial_attention,
    "temporal-attention": temporal_attention,
    "encoder-layers": encoder_layers,
    "recurrence": recurrence,
    "decoder": decoder,
    "box-code": box_code,
    "segmentation": segmentation,
}
NO_FIGURES: dict[str, drawing.Draw] = {}
