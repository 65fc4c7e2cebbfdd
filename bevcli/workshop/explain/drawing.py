"""Parts that the figures share: titles, BEV axes, camera images, boxes and feature colours."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon, Rectangle
from matplotlib.patheffects import AbstractPathEffect, Normal, Stroke
from matplotlib.text import Text
from numpy.typing import ArrayLike, NDArray

from bevcli.frame import BevMap, Frame
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.recording.colors import Color, map_colors
from bevcli.recording.log_bev import fit_colors
from bevcli.workshop.explain.trace import Trace

Draw = Callable[[Trace], Figure | str]  # the figure of one step, with its title, or why it cannot be drawn of a trace
Rect = tuple[float, float, float, float]  # left, bottom (in an image: top), width, height
INK, GREY, FAINT = "#1f2430", "#6b7280", "#d7dae0"
ACCENT, SECOND, THIRD, PALE = "#e4572e", "#1769aa", "#2a9d5c", "#9aa0ab"
WIDTH_INCHES, DPI = 14.0, 100
LEAST_SCORE = 0.3  # boxes below this are not drawn
MARK_M = 1.5  # least side of the square around the followed cell
VEHICLE_M = (4.6, 1.9)  # length and width of the drawn vehicle
MAP_COLORS: dict[str, Color] = {
    "drivable_road": (201, 206, 216),
    "lane_boundary": (242, 169, 0),
    "pedestrian_crossing": (95, 163, 211),
    "vehicle": (228, 87, 46),
    "drivable_area": (221, 224, 216),
    "divider": (199, 125, 0),
    "contour": (23, 105, 170),
}
OTHER_MAP_COLORS: tuple[Color, ...] = (
    (42, 157, 92), (142, 91, 181), (160, 90, 44), (214, 93, 177), (58, 63, 75), (127, 184, 0), (10, 165, 165),
    (125, 133, 151),
)  # fmt: skip
page_colors = partial(map_colors, named=MAP_COLORS, others=OTHER_MAP_COLORS)  # map classes -> colours on a white page


def titled_figure(height_inches: float, title: str, subtitle: str, heading_inches: float = 1.55) -> Figure:
    """A figure without global state. Its top `heading_inches` hold the title and a subtitle of one or two lines."""
    figure = Figure(figsize=(WIDTH_INCHES, height_inches), dpi=DPI, facecolor="white")
    inch = 1 / height_inches
    figure.text(0.015, 1 - 0.16 * inch, title, fontsize=19, fontweight="bold", color=INK, va="top")
    figure.text(0.015, 1 - 0.56 * inch, subtitle, fontsize=13, color=GREY, va="top", linespacing=1.35)
    figure.subplots_adjust(left=0.045, right=0.985, bottom=0.55 * inch, top=1 - heading_inches * inch)
    return figure


def bev_panel(figure: Figure, place: SubplotSpec, trace: Trace, title: str, y_labels: bool = True) -> Axes:
    """New axes at a place of the figure's grid: the BEV grid's area in metres, with the vehicle."""
    axes = figure.add_subplot(place)
    bev_axes(axes, trace, title)
    if not y_labels:
        axes.set(ylabel="", yticklabels=[])
    return axes


def bev_axes(axes: Axes, trace: Trace, title: str, ticks: bool = True) -> None:
    """Sets up an axes as the BEV grid's area in metres and draws the vehicle."""
    axes.set(xlim=trace.grid.x_range_m, ylim=trace.grid.y_range_m, aspect="equal")
    axes.set_title(title, fontsize=13, color=INK, loc="left", pad=7)
    axes.tick_params(labelsize=10, colors=GREY, length=3)
    if ticks:
        axes.set_xlabel("x, m", fontsize=11, color=GREY, labelpad=1)
        axes.set_ylabel("y, m", fontsize=11, color=GREY, labelpad=-2)
    else:
        axes.set(xticks=[], yticks=[])
    axes.spines[:].set_color(FAINT)
    axes.add_patch(Polygon(vehicle_outline(trace.frame), closed=True, fc="white", ec=INK, lw=1.4, zorder=8))


def vehicle_outline(frame: Frame) -> Array:
    """(5, 2) outline of the vehicle with a pointed front, metres, bev frame."""
    length, width = VEHICLE_M
    front, back, half = 0.5 * length + 1.4, 1.4 - 0.5 * length, width / 2
    points = [[back, -half, 0], [back, half, 0], [front - 1.2, half, 0], [front, 0, 0], [front - 1.2, -half, 0]]
    return apply(inverse(frame.rig.ego_from_bev), points)[:, :2]


def show_bev(axes: Axes, trace: Trace, image: NDArray, **options: Any) -> AxesImage:
    """An array (Y, X) or (Y, X, 3), rows from the smallest y, over the grid's area. Returns matplotlib's image."""
    extent = (*trace.grid.x_range_m, *trace.grid.y_range_m)
    return axes.imshow(image, extent=extent, origin="lower", interpolation="nearest", zorder=0, **options)


def show_map(axes: Axes, trace: Trace, bev_map: BevMap, **options: Any) -> None:
    """A map in the colours of its classes, cut at the grid's area."""
    image = np.full((*bev_map.cells.shape, 3), 255, np.uint8)
    for name, color in page_colors(bev_map.classes).items():
        image[bev_map.layer(name)] = color  # later classes lie on top
    axes.imshow(image, extent=(*bev_map.x_range_m, *bev_map.y_range_m), zorder=0, **options)
    axes.set(xlim=trace.grid.x_range_m, ylim=trace.grid.y_range_m)


def color_bar(figure: Figure, image: ScalarMappable, place: Rect, ticks: Sequence[float] | None = None) -> Colorbar:
    """An upright colour bar at a place of the figure."""
    bar = figure.colorbar(image, cax=figure.add_axes(place), ticks=ticks)
    bar.ax.tick_params(labelsize=10, colors=GREY)
    return bar


def arrow(axes: Axes, start: ArrayLike, end: ArrayLike, width: float, size: float = 10, **options: Any) -> None:
    """An arrow in the axes' units. width: of the line, points. size: of the head, points."""
    props = {"arrowstyle": "-|>", "color": SECOND, "lw": width, "shrinkA": 0, "shrinkB": 0, "mutation_scale": size}
    axes.annotate("", tuple(np.asarray(end)), xytext=tuple(np.asarray(start)), arrowprops=props, **options)


def paper(pad: float, alpha: float) -> dict[str, Any]:
    """The `bbox` of a text on a white ground."""
    return {"boxstyle": f"round,pad={pad}", "fc": "white", "ec": "none", "alpha": alpha}


def legend(axes: Axes, handles: list[Line2D] | None = None, size: float = 11, **options: Any) -> None:
    """The legend at the lower right, on top of all else. handles: default all that has a label."""
    axes.legend(handles=handles, fontsize=size, loc="lower right", framealpha=0.95, **options).set_zorder(20)


def grid_lines(axes: Axes, grid: BevGrid, color: str, width: float, most: int | None = None) -> None:
    """Lines between the cells of a grid. most: along an axis with more cells, leave out lines."""
    for low, cells, size, draw in (
        (grid.x_range_m[0], grid.columns, grid.cell_size_m[0], axes.axvline),
        (grid.y_range_m[0], grid.rows, grid.cell_size_m[1], axes.axhline),
    ):
        for line in range(0, cells + 1, 1 if most is None else max(1, cells // most)):
            draw(low + line * size, color=color, lw=width, zorder=1)


def show_lengths(axes: Axes, trace: Trace, lengths: NDArray, camera: int, **options: Any) -> None:
    """The lengths of the feature vectors of one camera (index into the model's), of all (N, H, W), as colours."""
    low, high = np.percentile(lengths, (2, 99.5))
    height, width = trace.prepared.images.shape[-2:]
    size = trace.frame.rig[trace.prepared.assignment.cameras[camera]]
    scale = trace.prepared.scales[camera]
    axes.imshow(lengths[camera], extent=(0, width, height, 0), cmap="magma", vmin=low, vmax=high, **options)
    axes.set(xlim=(0, size.width * scale), ylim=(size.height * scale, 0))
    bare(axes)


def mark_cell(axes: Axes, trace: Trace) -> None:
    """A square around the followed cell, drawn at least MARK_M wide."""
    size = np.maximum(trace.grid.cell_size_m, MARK_M)
    outline(axes, (*(trace.cell_center - size / 2), *size), (4.5, 2.2), zorder=9)


def outline(axes: Axes, place: Rect, widths: tuple[float, float], zorder: float = 1) -> None:
    """A rectangle with a white border. widths: of the white and of the coloured line."""
    for color, width, order in (("white", widths[0], zorder), (ACCENT, widths[1], zorder + 1)):
        axes.add_patch(Rectangle(place[:2], *place[2:], fc="none", ec=color, lw=width, zorder=order))


def outline_boxes(
    axes: Axes, boxes: Boxes3D, color: str, width: float = 1.6, style: str = "-", halo: bool = False
) -> None:
    """Boxes in the bev frame from above, with a line to the front. halo: a white border, for boxes on coloured maps."""
    corners = boxes.corners()[:, :4, :2]
    effects: list[AbstractPathEffect] = [Normal()]
    if halo:
        effects.insert(0, Stroke(linewidth=width + 1.8, foreground="white", alpha=0.85))
    for box, center in zip(corners, boxes.centers[:, :2], strict=True):
        polygon = Polygon(box, closed=True, fc="none", ec=color, lw=width, ls=style, zorder=6, path_effects=effects)
        axes.add_patch(polygon)
        nose = (box[0] + box[3]) / 2
        axes.plot(*zip(center, nose, strict=True), color=color, lw=width, zorder=6, path_effects=effects)


def rgb_image(frame: Frame, camera: str) -> NDArray[np.uint8]:
    """(H, W, 3) RGB; grey where the image is missing."""
    size = frame.rig[camera]
    image = frame.images.get(camera)
    return np.full((size.height, size.width, 3), 225, np.uint8) if image is None else image.pixels_bgr[..., ::-1]


def show_camera(axes: Axes, frame: Frame, name: str, title: str | None = None) -> None:
    """A camera's image with its name; a grey field where the image is missing."""
    camera = frame.rig[name]
    if name not in frame.images:
        axes.text(camera.width / 2, camera.height / 2, "no image", ha="center", color=GREY, fontsize=13)
    axes.imshow(rgb_image(frame, name), interpolation="antialiased")
    axes.set(xlim=(0, camera.width), ylim=(camera.height, 0))
    bare(axes)
    axes.set_title(name if title is None else title, fontsize=12, color=INK, loc="left", pad=5)


def table_text(axes: Axes, top: float, bottom: float) -> Callable[..., Text]:
    """`axes.text` for the cells of a table on these axes: 12 points, centred about the line. Columns are 0 to 10."""
    axes.set(xlim=(0, 10), ylim=(bottom, top))
    axes.axis("off")
    return partial(axes.text, fontsize=12, color=INK, va="center")


def bare(axes: Axes) -> None:
    """No ticks, a thin frame."""
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_color(FAINT)


def project_bev(frame: Frame, camera: Camera, points_bev: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Points (..., 3), metres, bev frame -> pixels (..., 2) of the image as read, and which are visible (...)."""
    world_from_bev = frame.world_from_ego.matrix @ frame.rig.ego_from_bev
    ego_from_world = inverse(frame.world_from_ego_at[camera.name].matrix)
    pixels, depth = camera.project_ego(apply(ego_from_world @ world_from_bev, points_bev))
    return pixels, camera.contains(pixels, depth)


def feature_colors(features: Sequence[NDArray]) -> list[NDArray[np.uint8]]:
    """Maps (Y, X, C) -> images (Y, X, 3): three principal components of all maps together as red, green, blue."""
    cells = np.concatenate([part.reshape(-1, part.shape[-1]) for part in features])
    colors = fit_colors("pca", cells)
    return [colors.paint(part) for part in features]


def cosine_to(features: NDArray, cell: tuple[int, int]) -> NDArray:
    """(Y, X, C) -> (Y, X) cosine similarity with the cell's vector, after the mean of all cells is removed."""
    centered = features - features.reshape(-1, features.shape[-1]).mean(0)
    centered = centered / np.maximum(np.linalg.norm(centered, axis=-1, keepdims=True), 1e-9)
    return np.asarray(centered @ centered[cell])
