"""The sheet: all cameras' pictures with their overlay, laid out around the vehicle, and the coverage map between them."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.rig_checks import RigReport
from bevcli.geometry.rig_findings import Finding
from bevcli.geometry.rig_pose import mounting_of, seen_fov_deg
from bevcli.geometry.transforms import Array
from bevcli.viz.calibration_map import FAINT, INK, LEGEND_STYLE, PAPER, draw_coverage, save
from bevcli.viz.calibration_overlay import GROUND, HORIZON, PILLAR_GRID, Picture, draw_overlay, height_colors

SEVERITY_COLORS = {"error": "#ff5c72", "warning": "#ffc857", "info": "#7fb7e6"}
SIDE_DEG = (75.0, 105.0)  # cameras that look sideways stand beside the map
SLOT = (4.8, 3.1)  # inches a camera
PICTURE_WIDTH = 960


def write_sheet(path: Path, rig: CameraRig, report: RigReport, pictures: Mapping[str, Picture]) -> None:
    """Write the PNG. pictures: by camera (H, W, 3) BGR; a camera without one gets a dark field. Raises OutputError."""
    front, left, right, back = around(rig)
    columns = max(len(front), len(back), 3)
    middle = max(len(left), len(right), 2)
    rows = [bool(front) * 1.0, middle * 1.0, bool(back) * 1.0]
    figure = Figure(figsize=(columns * SLOT[0], sum(rows) * SLOT[1] + 0.5), dpi=90, facecolor=PAPER)
    grid = figure.add_gridspec(int(sum(rows)), 6 * columns, wspace=0.35, hspace=0.16,
                               left=0.02, right=0.985, top=0.965, bottom=0.035)  # fmt: skip
    first = int(rows[0])
    for row, cameras in ((0, front), (int(sum(rows)) - 1, back)):
        start = 3 * (columns - len(cameras))  # centred: a slot is six columns of the grid wide
        for place, camera in enumerate(cameras):
            slot = figure.add_subplot(grid[row, start + 6 * place : start + 6 * place + 6])
            _draw_camera(slot, camera, rig.ego_from_bev, pictures.get(camera.name), report)
    for cameras, columns_of in ((left, slice(0, 6)), (right, slice(6 * columns - 6, 6 * columns))):
        for place, camera in enumerate(cameras):
            slot = figure.add_subplot(grid[first + place, columns_of])
            _draw_camera(slot, camera, rig.ego_from_bev, pictures.get(camera.name), report)
    center = figure.add_subplot(grid[first : first + middle, 3 * columns - 4 : 3 * columns + 4])
    draw_coverage(center, rig, report.coverage)
    if not left:
        _write_findings(figure.add_subplot(grid[first : first + middle, 0:6]), report.findings)
    if not right:
        _write_legend(figure.add_subplot(grid[first : first + middle, 6 * columns - 6 : 6 * columns]))
    save(figure, path)


def around(rig: CameraRig) -> tuple[list[Camera], list[Camera], list[Camera], list[Camera]]:
    """The cameras that look ahead (left to right), left, right, and back (the vehicle's left first)."""
    yaws = {camera.name: float(np.degrees(camera.yaw)) for camera in rig.cameras}
    low, high = SIDE_DEG
    ahead = [c for c in rig.cameras if abs(yaws[c.name]) < low]
    back = [c for c in rig.cameras if abs(yaws[c.name]) > high]
    sides = [c for c in rig.cameras if low <= abs(yaws[c.name]) <= high]
    return (
        sorted(ahead, key=lambda c: -yaws[c.name]),
        [c for c in sides if yaws[c.name] > 0],
        [c for c in sides if yaws[c.name] < 0],
        sorted(back, key=lambda c: yaws[c.name] % 360),
    )


def _draw_camera(axes: Axes, camera: Camera, ego_from_bev: Array, picture: Picture | None, report: RigReport) -> None:
    if picture is not None and picture.shape[:2] != (camera.height, camera.width):
        picture = cv2.resize(picture, (camera.width, camera.height))
    axes.imshow(draw_overlay(camera, ego_from_bev, picture, PICTURE_WIDTH))
    axes.set_xticks([])
    axes.set_yticks([])
    mounting = mounting_of(camera.ego_from_camera)
    mine = [finding for finding in report.findings if finding.camera == camera.name]
    color = SEVERITY_COLORS[mine[0].severity] if mine else FAINT
    for spine in axes.spines.values():
        spine.set_color(color)
        spine.set_linewidth(2.5 if mine else 0.8)
    axes.set_title(camera.name, loc="left", color=INK, fontsize=11)
    details = f"yaw {mounting.yaw_deg:.0f}°  pitch {mounting.pitch_deg:.1f}°  roll {mounting.roll_deg:.1f}°"
    details += f"  height {mounting.height:.2f} m  view {seen_fov_deg(camera)[0]:.0f}°"
    axes.set_title(details, loc="right", color=FAINT, fontsize=8.5)
    if mine:
        box = {"facecolor": PAPER, "edgecolor": color, "alpha": 0.9, "boxstyle": "round,pad=0.4"}
        text = textwrap.fill(mine[0].message, 50)
        axes.text(0.02, 0.96, text, transform=axes.transAxes, va="top", color=color, fontsize=10, bbox=box)


def _write_findings(axes: Axes, findings: Sequence[Finding]) -> None:
    axes.axis("off")
    axes.text(0, 0.97, "Findings", color=INK, fontsize=13, va="top")
    if not findings:
        axes.text(0, 0.89, "none: the rig looks healthy", color="#7fd6a0", fontsize=10, va="top")
    height = 0.89
    for finding in findings:
        where = f"{finding.camera}: " if finding.camera else ""
        numbers = f" ({finding.found})" if finding.found else ""
        lines = textwrap.wrap(f"{where}{finding.message}{numbers}", 58)[:4]
        if height - 0.04 * len(lines) < 0.03:
            axes.text(0, height, "and more: see the table", color=FAINT, fontsize=9, va="top")
            break
        axes.text(0, height, finding.severity, color=SEVERITY_COLORS[finding.severity], fontsize=9, va="top")
        axes.text(0.15, height, "\n".join(lines), color=INK, fontsize=9, va="top", linespacing=1.25)
        height -= 0.04 * len(lines) + 0.025


def _write_legend(axes: Axes) -> None:
    axes.axis("off")
    axes.text(0.1, 0.97, "How to read it", color=INK, fontsize=13, va="top")
    heights = PILLAR_GRID.pillar_heights()
    colors = [tuple(color / 255) for color in height_colors(PILLAR_GRID)]
    dots = [
        Line2D(
            [], [], color=color, marker="o", linestyle="none", label=f"pillar point {height:+.1f} m in the bev frame"
        )
        for color, height in zip(colors[::-1], heights[::-1], strict=True)
    ]
    lines = [
        Line2D([], [], color=tuple(np.array(HORIZON) / 255), label="the horizon: far away, at the camera's height"),
        Line2D([], [], color=tuple(np.array(GROUND) / 255), label="the ground, every 5 m: it should lie on the road"),
    ]
    axes.legend(handles=dots + lines, loc="upper left", bbox_to_anchor=(0.08, 0.93), labelspacing=0.9, **LEGEND_STYLE)
