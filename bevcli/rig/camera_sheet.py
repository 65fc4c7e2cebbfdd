"""cameras.png: all cameras' images with their overlay, arranged around the vehicle and the coverage map."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bevcli.findings import Finding
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.rig.coverage_map import FAINT, INK, LEGEND_STYLE, PAPER, draw_coverage, save
from bevcli.rig.mounting import degrees_text, mounting_of, seen_fov_deg
from bevcli.rig.overlay import GROUND, HORIZON, PILLAR_GRID, Pixels, draw_overlay, height_colors
from bevcli.rig.rig_report import RigReport

SEVERITY_COLORS = {"error": "#ff5c72", "warning": "#ffc857", "info": "#7fb7e6"}
SIDE_DEG = (75.0, 105.0)  # cameras with a yaw in this range are placed beside the map
DPI = 100
# Layout in inches: width of an image, gap between images, title above and details below an image, size of the map.
SLOT, GAP, TITLE, DETAILS, MIDDLE = 5.2, 0.3, 0.32, 0.38, 5.2
FOOTER = 3.0  # findings and legend, where cameras are placed beside the map
LINE = 0.19  # height of a line of text
IMAGE_WIDTH = 1040  # pixels


def write_camera_sheet(path: Path, rig: CameraRig, report: RigReport, images: Mapping[str, Pixels]) -> None:
    """Write the PNG. Raises OutputError.

    images: by camera, (H, W, 3) BGR; a camera without an image is drawn on a dark background.
    """
    front, left, right, back = _cameras_by_side(rig)
    columns = max(len(front), len(back), 3)
    heights = [_row_height(front), max(_column_height(left), _column_height(right), MIDDLE), _row_height(back)]
    footer = FOOTER if left or right else 0.0
    sheet = _Sheet(columns * (SLOT + GAP) + GAP, sum(heights) + footer + 2 * GAP)
    tops = GAP + np.cumsum([0.0, *heights[:2]])
    for row, top in ((front, tops[0]), (back, tops[2])):
        start = (sheet.width - len(row) * (SLOT + GAP) + GAP) / 2
        for place, camera in enumerate(row):
            _draw_camera(sheet, (start + place * (SLOT + GAP), top), camera, rig, report, images)
    for column, start in ((left, GAP), (right, sheet.width - SLOT - GAP)):
        top = tops[1]
        for camera in column:
            _draw_camera(sheet, (start, top), camera, rig, report, images)
            top += _camera_height(camera)
    size, top = MIDDLE - 1.1, tops[1] + (heights[1] - MIDDLE) / 2 + 0.35
    draw_coverage(sheet.axes((sheet.width - size) / 2 + 0.1, top, size, size), rig, report.coverage)
    if footer:
        top, size = sheet.height - GAP - footer, footer
    _write_findings(sheet.axes(GAP, top, SLOT, size), size, report.findings)
    _write_legend(sheet.axes(sheet.width - SLOT - GAP, top, SLOT, size))
    save(sheet.figure, path)


class _Sheet:
    """A figure on which axes are placed in inches from the top left corner."""

    def __init__(self, width: float, height: float) -> None:
        self.width, self.height = width, height
        self.figure = Figure(figsize=(width, height), dpi=DPI, facecolor=PAPER)

    def axes(self, left: float, top: float, width: float, height: float) -> Axes:
        bottom = self.height - top - height
        box = (left / self.width, bottom / self.height, width / self.width, height / self.height)
        return self.figure.add_axes(box)


def _camera_height(camera: Camera) -> float:
    return TITLE + SLOT * min(camera.height / camera.width, 1.0) + DETAILS


def _row_height(cameras: Sequence[Camera]) -> float:
    return max(map(_camera_height, cameras), default=0.0)


def _column_height(cameras: Sequence[Camera]) -> float:
    return sum(map(_camera_height, cameras))


def _cameras_by_side(rig: CameraRig) -> tuple[list[Camera], list[Camera], list[Camera], list[Camera]]:
    """The cameras that look ahead (from left to right), left, right, and back (from the vehicle's left to right)."""
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


def _draw_camera(
    sheet: _Sheet,
    corner: tuple[float, float],
    camera: Camera,
    rig: CameraRig,
    report: RigReport,
    images: Mapping[str, Pixels],
) -> None:
    """Draw a camera's image with title, angles and its first finding. corner: left and top, inches."""
    left, top = corner
    axes = sheet.axes(left, top + TITLE, SLOT, _camera_height(camera) - TITLE - DETAILS)
    image = images.get(camera.name)
    if image is not None and image.shape[:2] != (camera.height, camera.width):
        image = cv2.resize(image, (camera.width, camera.height)).astype(np.uint8)
    axes.imshow(draw_overlay(camera, rig.ego_from_bev, image, IMAGE_WIDTH))
    axes.set_xticks([])
    axes.set_yticks([])
    mounting = mounting_of(camera.ego_from_camera)
    mine = [finding for finding in report.findings if finding.camera == camera.name]
    color = SEVERITY_COLORS[mine[0].severity] if mine else FAINT
    for spine in axes.spines.values():
        spine.set_color(color)
        spine.set_linewidth(2.5 if mine else 0.8)
    axes.set_title(camera.name, loc="left", color=INK, fontsize=11)
    angles = (degrees_text(mounting.yaw_deg, 0), degrees_text(mounting.pitch_deg), degrees_text(mounting.roll_deg))
    details = "yaw {}  pitch {}  roll {}".format(*angles)
    details += f"  height {mounting.height:.2f} m  FOV {seen_fov_deg(camera)[0]:.0f}°"
    axes.set_xlabel(details, color=FAINT, fontsize=9, loc="left", labelpad=5)
    if mine:
        box = {"facecolor": PAPER, "edgecolor": color, "alpha": 0.9, "boxstyle": "round,pad=0.4"}
        text = textwrap.fill(mine[0].message, 50)
        axes.text(0.02, 0.96, text, transform=axes.transAxes, va="top", color=color, fontsize=10, bbox=box)


def _write_findings(axes: Axes, height: float, findings: Sequence[Finding]) -> None:
    """Write as many findings as fit. height: of the axes, inches."""
    axes.axis("off")
    axes.set_ylim(height, 0)
    axes.text(0, 0, "Findings", color=INK, fontsize=13, va="top")
    if not findings:
        axes.text(0, 0.45, "none: the rig is plausible", color="#7fd6a0", fontsize=10, va="top")
    top = 0.45
    for finding in findings:
        where = f"{finding.camera}: " if finding.camera else ""
        numbers = f" ({finding.found})" if finding.found else ""
        lines = textwrap.wrap(f"{where}{finding.message}{numbers}", 56)[:4]
        if top + LINE * len(lines) > height - LINE:
            axes.text(0, top, "more in findings.json", color=FAINT, fontsize=9, va="top")
            break
        axes.text(0, top, finding.severity, color=SEVERITY_COLORS[finding.severity], fontsize=9, va="top")
        axes.text(0.15, top, "\n".join(lines), color=INK, fontsize=9, va="top", linespacing=1.25)
        top += LINE * len(lines) + 0.08


def _write_legend(axes: Axes) -> None:
    axes.axis("off")
    axes.text(0.1, 1.0, "Legend", color=INK, fontsize=13, va="top", transform=axes.transAxes)
    heights = PILLAR_GRID.pillar_heights()
    colors = [tuple(color / 255) for color in height_colors(PILLAR_GRID)]
    dots = [
        Line2D(
            [], [], color=color, marker="o", linestyle="none", label=f"pillar point {height:+.1f} m in the bev frame"
        )
        for color, height in zip(colors[::-1], heights[::-1], strict=True)
    ]
    lines = [
        Line2D([], [], color=tuple(np.array(HORIZON) / 255), label="horizon: infinitely far, at the camera's height"),
        Line2D([], [], color=tuple(np.array(GROUND) / 255), label="ground grid of 5 m: should lie on the road"),
    ]
    axes.legend(handles=dots + lines, loc="upper left", bbox_to_anchor=(0.08, 0.94), labelspacing=0.9, **LEGEND_STYLE)
