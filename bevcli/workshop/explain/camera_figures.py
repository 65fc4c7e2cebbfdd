"""Figures of the steps that look into the images: features, pillars, spatial cross-attention."""

from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from bevcli.frame import CameraSamples
from bevcli.geometry.transforms import Array
from bevcli.workshop.explain import drawing
from bevcli.workshop.explain.drawing import ACCENT, GREY, INK, SECOND
from bevcli.workshop.explain.trace import Trace

MOST_CAMERAS = 6  # columns of the feature figure
HEIGHT_COLORS = ("#7b3ff2", "#1f8fe0", "#1fae6a", "#f2a900", "#e4572e", "#c2185b")  # lowest pillar point first


def image_features(trace: Trace) -> Figure:
    """The neck's feature maps over the images."""
    names = trace.prepared.assignment.cameras[:MOST_CAMERAS]
    rows = len(trace.feature_maps) + 1
    figure = drawing.titled_figure(
        1.35 + 1.42 * rows,
        "Image features: what the backbone and the neck make of the images",
        "Top: the images. Below: the length of the feature vector at each position, one row per feature level.\n"
        "Each of these positions becomes one token that BEV cells can sample.",
        heading_inches=1.45,
    )
    grid = figure.add_gridspec(rows, len(names), wspace=0.04, hspace=0.22, left=0.06, right=0.99, bottom=0.02)
    for column, name in enumerate(names):
        axes = figure.add_subplot(grid[0, column])
        drawing.show_camera(axes, trace.frame, name)
        axes.title.set_fontsize(10)
    for row, maps in enumerate(trace.feature_maps, start=1):
        lengths = maps.norm(dim=1).float().cpu().numpy()  # (N, H_l, W_l)
        for column in range(len(names)):
            axes = figure.add_subplot(grid[row, column])
            drawing.show_lengths(axes, trace, lengths, column)
            if column == 0:
                shape = " × ".join(map(str, maps.shape[-3:]))
                axes.set_ylabel(f"level {row}\n{shape}", fontsize=11, color=INK)
    return figure


def pillars(trace: Trace) -> Figure:
    """The pillar of the followed cell in the cameras that see it, and how many cameras see each cell."""
    heights = trace.grid.pillar_heights()
    cameras = _cameras_of_cell(trace)
    figure = drawing.titled_figure(
        8.2,
        "Pillars and 3D reference points: from a BEV cell into the cameras",
        f"A pillar of {len(heights)} points stands on each BEV cell. Its points are projected into every camera with "
        "the calibration.\nThe cell attends in a camera only if at least one of its points is visible there.",
        heading_inches=1.5,
    )
    grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.1), wspace=0.09, hspace=0.12, bottom=0.03, left=0.012)
    for place in range(2):
        axes = figure.add_subplot(grid[place, 0])
        if place < len(cameras):
            drawing.show_camera(axes, trace.frame, cameras[place])
            _draw_pillars(axes, trace, cameras[place])
        else:
            _empty(axes, "no further camera sees this cell" if cameras else "no camera sees this cell")
    axes = figure.add_subplot(grid[:, 1])
    _draw_camera_counts(axes, trace)
    for z, color in reversed(list(zip(heights, cycle(HEIGHT_COLORS)))):
        axes.plot([], [], "o", color=color, ms=9, label=f"z = {z:.2f} m")
    drawing.legend(axes, title="pillar points", title_fontsize=11)
    return figure


def spatial_attention(trace: Trace) -> Figure:
    """The sampling points of the followed cell in the last encoder layer, per camera."""
    x, y = trace.cell_center
    attention = trace.prediction.attention
    probes = () if attention is None else attention.probes
    samples = dict(probes[0].cameras) if probes else {}
    cameras = list(samples)[:2]
    rows = max(len(cameras), 1)
    figure = drawing.titled_figure(
        1.6 + 3.55 * rows,
        "Spatial cross-attention: where one BEV cell looks in the images",
        f"Cell at x = {x:.1f} m, y = {y:.1f} m, last encoder layer, all heads and feature levels. Crosses: projected "
        "pillar points.\nDots: learned sampling points around them; larger and brighter dots have a larger attention "
        "weight.",
    )
    grid = figure.add_gridspec(rows, 2, wspace=0.03, hspace=0.14, bottom=0.02, left=0.012, right=0.935)
    if not cameras:
        _empty(figure.add_subplot(grid[0, :]), "no camera sees this cell")
        return figure
    largest = max(float(part.weights.max()) for part in samples.values())
    for row, name in enumerate(cameras):
        whole, zoomed = (figure.add_subplot(grid[row, column]) for column in range(2))
        drawing.show_camera(whole, trace.frame, name)
        drawing.show_camera(zoomed, trace.frame, name, "enlarged")
        window = _zoom_window(trace, name, samples[name])
        drawing.outline(whole, window, (3, 1.6))
        _draw_samples(whole, trace, name, samples[name], largest, size=30)
        dots = _draw_samples(zoomed, trace, name, samples[name], largest, size=160)
        zoomed.set(xlim=(window[0], window[0] + window[2]), ylim=(window[1] + window[3], window[1]))
    drawing.color_bar(figure, dots, (0.944, 0.08, 0.011, 0.6)).set_label("attention weight", fontsize=11, color=GREY)
    return figure


def _cameras_of_cell(trace: Trace) -> list[str]:
    """The cameras that see the followed cell, those with the most visible points first."""
    points = trace.visible[:, trace.cell_index].sum(-1).tolist()
    names = trace.prepared.assignment.cameras
    order = sorted((i for i, count in enumerate(points) if count), key=lambda i: -points[i])
    return [names[i] for i in order]


def _draw_pillars(axes: Axes, trace: Trace, name: str) -> None:
    camera = trace.frame.rig[name]
    grid = trace.grid
    step = max(1, round(4.0 / grid.cell_size_m[0]))
    pillars = grid.pillars()[trace.cell[0] % step :: step, trace.cell[1] % step :: step]
    pixels, visible = drawing.project_bev(trace.frame, camera, pillars.reshape(-1, grid.pillar_points, 3))
    for column, seen in zip(pixels, visible, strict=True):
        if seen.all():
            axes.plot(*column.T, "-", color="white", lw=0.6, alpha=0.55, zorder=2)
            axes.plot(*column.T, ".", color="white", ms=2.5, alpha=0.7, zorder=2)
    own, _ = drawing.project_bev(trace.frame, camera, grid.pillars()[trace.cell])
    axes.plot(*own.T, "-", color="white", lw=4, zorder=4)
    axes.plot(*own.T, "-", color=INK, lw=1.6, zorder=5)
    for pixel, color in zip(own, cycle(HEIGHT_COLORS)):
        axes.plot(*pixel, "o", color=color, ms=10, mec="white", mew=1.6, zorder=6, clip_on=True)


def _draw_camera_counts(axes: Axes, trace: Trace) -> None:
    grid = trace.grid
    counts = trace.visible.any(-1).sum(0).cpu().numpy().reshape(grid.rows, grid.columns)
    most = max(int(counts.max()), 2)
    shades = ["#f1f2f4", "#bcd9ee", "#5fa3d3", "#1769aa", "#0b3d68"]
    colors = ListedColormap(shades[: most + 1] if most < len(shades) else shades)
    drawing.bev_axes(axes, trace, "Number of cameras that see each BEV cell")
    image = drawing.show_bev(axes, trace, counts, cmap=colors, vmin=-0.5, vmax=colors.N - 0.5)
    drawing.mark_cell(axes, trace)
    text = f"followed cell\nrow {trace.cell[0]}, column {trace.cell[1]}"
    label = axes.annotate(text, tuple(trace.cell_center), (-14, 14), textcoords="offset points", ha="right", zorder=12)
    label.set(fontsize=12, color=ACCENT, fontweight="bold", bbox=drawing.paper(0.25, 0.85))
    bar = axes.figure.colorbar(image, ax=axes, ticks=range(colors.N), shrink=0.55, pad=0.02)
    bar.ax.tick_params(labelsize=11, colors=GREY, length=0)


def _zoom_window(trace: Trace, name: str, samples: CameraSamples) -> drawing.Rect:
    """Left, top, width, height of the part that holds the most weight, in the image's aspect."""
    whole = np.array([trace.frame.rig[name].width, trace.frame.rig[name].height], dtype=np.float64)
    points, weights = _inside(samples, whole)
    if not len(points):
        return 0.0, 0.0, float(whole[0]), float(whole[1])
    center = np.average(points, axis=0, weights=np.maximum(weights, 1e-9))
    order = np.sort(np.abs(points - center) / whole, axis=0)
    size = whole * np.clip(2.2 * order[int(0.8 * (len(order) - 1))].max(), 0.15, 0.42)
    x, y = np.clip(center - size / 2, 0, whole - size)
    return float(x), float(y), float(size[0]), float(size[1])


def _draw_samples(
    axes: Axes, trace: Trace, name: str, samples: CameraSamples, largest: float, size: float
) -> PathCollection:
    camera = trace.frame.rig[name]
    points, weights = _inside(samples, np.array([camera.width, camera.height], dtype=np.float64))
    order = np.argsort(weights)
    shares = weights[order] / largest
    own, visible = drawing.project_bev(trace.frame, camera, trace.grid.pillars()[trace.cell])
    x, y = own[visible].T
    axes.scatter(x, y, marker="x", s=3 * size, c="white", linewidths=0.03 * size + 1.5, zorder=3)
    axes.scatter(x, y, marker="x", s=2.4 * size, c=SECOND, linewidths=0.014 * size + 0.8, zorder=3)
    x, y = points[order].T
    dots = axes.scatter(x, y, s=size * (0.12 + shares), c=weights[order], cmap="viridis", vmin=0, vmax=largest)
    dots.set(edgecolors="white", linewidths=0.02 * size**0.8, zorder=4)
    return dots


def _inside(samples: CameraSamples, size: Array) -> tuple[Array, Array]:
    """The samples within the image, pixels (K, 2) and weights (K,)."""
    with np.errstate(invalid="ignore"):
        inside = ((samples.pixels >= 0) & (samples.pixels < size)).all(-1)
    return samples.pixels[inside], samples.weights[inside]


def _empty(axes: Axes, text: str) -> None:
    drawing.bare(axes)
    axes.set_facecolor("#f6f7f9")
    axes.text(0.5, 0.5, text, ha="center", va="center", fontsize=14, color=GREY, transform=axes.transAxes)
