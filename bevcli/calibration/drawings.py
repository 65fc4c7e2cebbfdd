"""calibration.png: what each camera sees, with the stated and with the measured calibration."""

from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from bevcli.calibration.estimates import CameraEstimate, Verdict
from bevcli.calibration.evidence import Evidence, ShownMatches, epipolar_piece
from bevcli.calibration.table import change_text
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array
from bevcli.rig.drawings import FAINT, INK, PAPER, save
from bevcli.rig.mounting import horizon
from bevcli.rig.overlay import GROUND, HORIZON, ground_lines, visible_runs

ROW_INCHES, WIDTH_INCHES = 2.9, 15.0
POINT, LINE = (255, 120, 90), (110, 200, 255)  # RGB
COLORS = {Verdict.FINE: "#7fd6a0", Verdict.CORRECTED: "#ffd640", Verdict.NOT_MEASURABLE: "#ff8080"}
HEADINGS = (
    "stated: matched points (red), their epipolar lines (blue)",
    "measured: ground grid (green), horizon (yellow)",
    "stated minus measured, 3 deviations",
)
Pixels = NDArray[np.uint8]


def write_sheet(path: Path, evidence: Evidence, cameras: tuple[CameraEstimate, ...]) -> None:
    """Write the sheet as a PNG, one row a camera. Raises OutputError."""
    height = ROW_INCHES * len(cameras) + 0.6
    figure = Figure(figsize=(WIDTH_INCHES, height), dpi=90, facecolor=PAPER)
    for left, text in zip((0.05, 0.43, 0.82), HEADINGS, strict=True):
        figure.text(left, 1 - 0.15 / height, text, color=INK, fontsize=11, va="top")
    for row, estimate in enumerate(cameras):
        bottom, size = 1 - (0.6 + ROW_INCHES * (row + 1)) / height, (ROW_INCHES - 0.45) / height
        for column in (0, 1):
            axes = figure.add_axes((0.01 + 0.38 * column, bottom + 0.1 / height, 0.37, size))
            camera = evidence.camera(row, measured=column == 1)
            _draw_image(axes, evidence.image(row), camera, evidence.matches(row, measured=column == 1))
        figure.text(0.01, bottom + size + 0.13 / height, _title(estimate), color=COLORS[estimate.verdict], fontsize=10)
        axes = figure.add_axes((0.82, bottom + 0.45 / height, 0.16, size - 0.4 / height))
        _draw_ellipse(axes, estimate)
    save(figure, path)


def _title(estimate: CameraEstimate) -> str:
    text = estimate.reason or change_text(estimate)
    return f"{estimate.camera}: {estimate.verdict.value}; {text}"


def _draw_image(axes: Axes, grey: Pixels | None, camera: Camera, matches: ShownMatches) -> None:
    """The image with the ground grid and the horizon, matched points, and pieces of their epipolar lines."""
    axes.set_xticks([])
    axes.set_yticks([])
    blank = np.full((camera.height, camera.width), 40, dtype=np.uint8)
    canvas = np.repeat((blank if grey is None else grey)[..., None], 3, axis=-1)
    _lines(canvas, ground_lines(camera), GROUND, 1)
    _lines(canvas, visible_runs(horizon(camera)), HORIZON, 2)
    for point, ray in zip(matches.pixels_b, matches.rays_a, strict=True):
        _lines(canvas, epipolar_piece(camera, matches.camera_b_from_camera_a, ray, point), LINE, 2)
        cv2.circle(canvas, (round(point[0]), round(point[1])), 4, POINT, -1, cv2.LINE_AA)
    axes.imshow(canvas)


def _lines(canvas: NDArray[np.uint8], lines: list[Array], color: tuple[int, int, int], thickness: int) -> None:
    points = [np.round(line * 16).astype(np.int32) for line in lines]
    cv2.polylines(canvas, points, False, color, thickness, cv2.LINE_AA, 4)


def _draw_ellipse(axes: Axes, estimate: CameraEstimate) -> None:
    """Yaw and pitch, with the ellipse of three standard deviations."""
    axes.set_facecolor(PAPER)
    yaw, pitch, _ = estimate.rotation_deg
    covariance = np.degrees(np.degrees(estimate.covariance[:2, :2]))[::-1, ::-1] * [[1, -1], [-1, 1]]
    sizes, turns = np.linalg.eigh(covariance)
    angle = float(np.degrees(np.arctan2(turns[1, 1], turns[0, 1])))
    width, height = 6 * np.sqrt(sizes[::-1])
    axes.add_patch(Ellipse((yaw, pitch), width, height, angle=angle, color=COLORS[estimate.verdict], alpha=0.5))
    axes.plot([0, yaw], [0, pitch], color=INK, linewidth=1)
    axes.plot([0], [0], "+", color=INK)
    reach = 1.2 * max(abs(yaw), abs(pitch), width, height, 0.3)
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_xlabel("yaw, degrees", color=FAINT, fontsize=8, labelpad=1)
    axes.set_ylabel("pitch, degrees", color=FAINT, fontsize=8, labelpad=1)
    axes.tick_params(colors=FAINT, labelsize=7)
    axes.grid(color=FAINT, alpha=0.25)
