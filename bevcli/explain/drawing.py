"""What the figures share: titles, BEV axes, camera images, boxes and feature colours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Polygon, Rectangle
from matplotlib.patheffects import AbstractPathEffect, Normal, Stroke
from numpy.typing import NDArray

from bevcli.explain.trace import Trace
from bevcli.frame import Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.recording.bev_images import fit_colors

INK, GREY, FAINT = "#1f2430", "#6b7280", "#d7dae0"
ACCENT, SECOND, THIRD = "#e4572e", "#1769aa", "#2a9d5c"
WIDTH_INCHES, DPI = 14.0, 100
LEAST_SCORE = 0.3  # boxes below this are not drawn
LEAST_VISIBILITY = 0.2  # ground truth below this is not drawn
VEHICLE_M = (4.6, 1.9)  # length and width of the drawn vehicle


def titled_figure(height_inches: float, title: str, subtitle: str, heading_inches: float = 1.55) -> Figure:
    """A figure without global state. Its top `heading_inches` hold the title and a subtitle of one or two lines."""
    figure = Figure(figsize=(WIDTH_INCHES, height_inches), dpi=DPI, facecolor="white")
    inch = 1 / height_inches
    figure.text(0.015, 1 - 0.16 * inch, title, fontsize=19, fontweight="bold", color=INK, va="top")
    figure.text(0.015, 1 - 0.56 * inch, subtitle, fontsize=13, color=GREY, va="top", linespacing=1.35)
    figure.subplots_adjust(left=0.045, right=0.985, bottom=0.55 * inch, top=1 - heading_inches * inch)
    return figure


def bev_axes(axes: Axes, trace: Trace, title: str, ticks: bool = True) -> None:
    """Sets up an axes as the BEV grid's area in metres and draws the vehicle."""
    grid = trace.grid
    axes.set_xlim(*grid.x_range_m)
    axes.set_ylim(*grid.y_range_m)
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=13, color=INK, loc="left", pad=7)
    axes.tick_params(labelsize=10, colors=GREY, length=3)
    if ticks:
        axes.set_xlabel("x, m", fontsize=11, color=GREY, labelpad=1)
        axes.set_ylabel("y, m", fontsize=11, color=GREY, labelpad=-2)
    else:
        axes.set_xticks([])
        axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color(FAINT)
    axes.add_patch(Polygon(vehicle_outline(trace.frame), closed=True, fc="white", ec=INK, lw=1.4, zorder=8))


def vehicle_outline(frame: Frame) -> Array:
    """(5, 2) outline of the vehicle with a pointed front, metres, bev frame."""
    length, width = VEHICLE_M
    front, back, half = 0.5 * length + 1.4, 1.4 - 0.5 * length, width / 2
    points = np.array([[back, -half], [back, half], [front - 1.2, half], [front, 0], [front - 1.2, -half]])
    ego = np.concatenate([points, np.zeros((5, 1))], axis=-1)
    outline: Array = apply(inverse(frame.rig.ego_from_bev), ego)[:, :2]
    return outline


def show_bev(axes: Axes, trace: Trace, image: NDArray, **options: Any) -> AxesImage:
    """An array (Y, X) or (Y, X, 3), rows from the smallest y, over the grid's area. Returns matplotlib's image."""
    grid = trace.grid
    extent = (*grid.x_range_m, *grid.y_range_m)
    return axes.imshow(image, extent=extent, origin="lower", interpolation="nearest", zorder=0, **options)


def mark_cell(axes: Axes, trace: Trace, color: str = ACCENT, least_m: float = 0.0) -> None:
    """A square around the followed cell, drawn at least `least_m` wide."""
    size = np.maximum(trace.grid.cell_size_m, least_m)
    corner = trace.cell_center - size / 2
    axes.add_patch(Rectangle(tuple(corner), *size, fc="none", ec="white", lw=4.5, zorder=9))
    axes.add_patch(Rectangle(tuple(corner), *size, fc="none", ec=color, lw=2.2, zorder=10))


def outline_boxes(
    axes: Axes, boxes: Boxes3D, color: str, width: float = 1.6, style: str = "-", halo: bool = False
) -> None:
    """Boxes in the bev frame from above; a line from the centre shows the heading.

    halo: a white border around the lines, for boxes on coloured maps.
    """
    corners = boxes.corners()[:, :4, :2]
    effects: list[AbstractPathEffect] = [Normal()]
    if halo:
        effects.insert(0, Stroke(linewidth=width + 1.8, foreground="white", alpha=0.85))
    for box, center in zip(corners, boxes.centers[:, :2], strict=True):
        outline = Polygon(box, closed=True, fc="none", ec=color, lw=width, ls=style, zorder=6)
        outline.set_path_effects(effects)
        axes.add_patch(outline)
        nose = (box[0] + box[3]) / 2
        axes.plot(*zip(center, nose, strict=True), color=color, lw=width, zorder=6, path_effects=effects)


def confident(boxes: Boxes3D, least: float = LEAST_SCORE) -> Boxes3D:
    """The boxes with a score of at least `least`; all of them where there are no scores."""
    return boxes if boxes.scores is None else boxes[boxes.scores >= least]


def ground_truth_in_bev(frame: Frame) -> Boxes3D | None:
    """The ground truth boxes in the bev frame, without the mostly hidden ones, where the sequence has any."""
    truth = frame.ground_truth
    if truth is None:
        return None
    if truth.visibilities is not None:
        truth = truth[~(truth.visibilities < LEAST_VISIBILITY)]  # unknown visibility is NaN and stays
    return truth.transformed(inverse(frame.world_from_ego.matrix @ frame.rig.ego_from_bev))


def rgb_image(frame: Frame, camera: str) -> NDArray[np.uint8] | None:
    """(H, W, 3) RGB, None where the image is missing."""
    image = frame.images.get(camera)
    return None if image is None else image.pixels_bgr[..., ::-1]


def show_camera(axes: Axes, frame: Frame, name: str, title: str | None = None) -> None:
    """A camera's image with its name; a grey field where the image is missing."""
    camera = frame.rig[name]
    image = rgb_image(frame, name)
    if image is None:
        image = np.full((camera.height, camera.width, 3), 225, np.uint8)
        axes.text(camera.width / 2, camera.height / 2, "no image", ha="center", color=GREY, fontsize=13)
    axes.imshow(image, interpolation="antialiased")
    axes.set_xlim(0, camera.width)
    axes.set_ylim(camera.height, 0)
    bare(axes)
    axes.set_title(name if title is None else title, fontsize=12, color=INK, loc="left", pad=5)


def bare(axes: Axes) -> None:
    """No ticks, a thin frame."""
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color(FAINT)


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
    similarity: NDArray = centered @ centered[cell]
    return similarity
