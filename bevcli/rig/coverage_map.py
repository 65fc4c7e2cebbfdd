"""coverage.png: the BEV grid from above, how many cameras see each cell, and the cameras' fields of view."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from bevcli.errors import OutputError
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.transforms import apply, inverse
from bevcli.rig.coverage import Coverage
from bevcli.rig.mounting import seen_range_deg

PAPER, INK, FAINT = "#14171c", "#e8ecf1", "#8a93a0"
COUNT_COLORS = (
    "#b3324a",
    "#2b4a63",
    "#3f8f8a",
    "#9fd67a",
    "#f4f1a1",
)  # of 0, 1, 2, 3, and 4 or more cameras
LEGEND_STYLE = {"facecolor": PAPER, "edgecolor": "none", "labelcolor": INK, "fontsize": 9}
CAR_LENGTH_M, CAR_WIDTH_M, AXLE_TO_TAIL_M = 4.6, 1.8, 1.0


def write_coverage_map(path: Path, rig: CameraRig, coverage: Coverage) -> None:
    """Write the map as a PNG. Raises OutputError."""
    figure = Figure(figsize=(9.6, 8.2), dpi=110, facecolor=PAPER)
    axes = figure.add_axes((0.08, 0.08, 0.72, 0.85))
    draw_coverage(axes, rig, coverage)
    axes.set_title("How many cameras see each BEV cell", color=INK, fontsize=13, loc="left", pad=12)
    figure.legend(handles=_legend(coverage), loc="upper left", bbox_to_anchor=(0.80, 0.935), **LEGEND_STYLE)
    save(figure, path)


def draw_coverage(axes: Axes, rig: CameraRig, coverage: Coverage) -> None:
    """Draw the map on axes: x and y of the bev frame in metres, with the vehicle and its cameras."""
    grid = coverage.grid
    colors, norm = ListedColormap(COUNT_COLORS), BoundaryNorm(np.arange(-0.5, 5), 5)
    extent = (*grid.x_range_m, *grid.y_range_m)
    shown = np.minimum(coverage.counts, 4)
    axes.imshow(shown, origin="lower", extent=extent, cmap=colors, norm=norm, interpolation="nearest")
    _draw_rings(axes, rig)
    _draw_vehicle(axes, rig)
    for camera in rig.cameras:
        _draw_camera(axes, camera, rig)
    axes.set_xlim(*grid.x_range_m)
    axes.set_ylim(*grid.y_range_m)
    axes.set_xlabel("x of the bev frame, m", color=FAINT, fontsize=9, labelpad=2)
    axes.set_ylabel("y of the bev frame, m", color=FAINT, fontsize=9, labelpad=1)
    axes.tick_params(colors=FAINT, labelsize=8)
    for spine in axes.spines.values():
        spine.set_color(FAINT)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG. Raises OutputError."""
    try:
        FigureCanvasAgg(figure).print_png(str(path))
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


def _legend(coverage: Coverage) -> Sequence[Patch]:
    words = ("no camera", "1 camera", "2 cameras", "3 cameras", "4 or more")
    counts = np.bincount(np.minimum(coverage.counts, 4).ravel(), minlength=5)
    shares = 100 * counts / counts.sum()
    rows = zip(COUNT_COLORS, words, shares, strict=True)
    return [
        Patch(color=color, label=f"{word}: {share:.1f}%") for color, word, share in rows if share or word == words[0]
    ]


def _draw_rings(axes: Axes, rig: CameraRig) -> None:
    center = inverse(rig.ego_from_bev)[:2, 3]
    angles = np.linspace(0, 2 * np.pi, 200)
    for radius in (10, 20, 30, 40, 50):
        x, y = center[0] + radius * np.cos(angles), center[1] + radius * np.sin(angles)
        axes.plot(x, y, color=INK, linewidth=0.5, alpha=0.35)
        axes.text(
            center[0], center[1] + radius, f"{radius} m", color=INK, fontsize=7, ha="center", va="bottom", alpha=0.8
        )


def _draw_vehicle(axes: Axes, rig: CameraRig) -> None:
    tail, half = -AXLE_TO_TAIL_M, CAR_WIDTH_M / 2
    nose = tail + CAR_LENGTH_M
    outline = [(tail, half), (tail, -half), (nose - 0.8, -half), (nose, 0), (nose - 0.8, half)]
    points = apply(inverse(rig.ego_from_bev), [(x, y, 0.0) for x, y in outline])
    axes.fill(points[:, 0], points[:, 1], facecolor=PAPER, edgecolor=INK, linewidth=1.2, zorder=4)


def _draw_camera(axes: Axes, camera: Camera, rig: CameraRig) -> None:
    bev_from_camera = inverse(rig.ego_from_bev) @ camera.ego_from_camera
    place, forward = bev_from_camera[:2, 3], bev_from_camera[:2, 2]
    yaw = float(np.degrees(np.arctan2(forward[1], forward[0])))
    for angle in np.radians(yaw - np.array(seen_range_deg(camera, 0))):
        end = place + 80 * np.array([np.cos(angle), np.sin(angle)])
        axes.plot([place[0], end[0]], [place[1], end[1]], color=INK, linewidth=0.7, alpha=0.6, zorder=3)
    label = place + 27 * np.array([np.cos(np.radians(yaw)), np.sin(np.radians(yaw))])
    box = {"facecolor": PAPER, "edgecolor": "none", "alpha": 0.75, "boxstyle": "round,pad=0.25"}
    axes.text(
        float(label[0]),
        float(label[1]),
        camera.name,
        color=INK,
        fontsize=8,
        ha="center",
        va="center",
        bbox=box,
        zorder=5,
        clip_on=True,
    )
