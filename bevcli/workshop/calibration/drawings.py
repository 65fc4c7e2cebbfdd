"""calibration.png: what each camera sees, with the stated and with the measured calibration."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array
from bevcli.rig.drawings import (
    FAINT,
    GROUND,
    HORIZON,
    INK,
    PAPER,
    draw_lines,
    ground_lines,
    horizon,
    save,
    visible_runs,
)
from bevcli.workshop.calibration.adjustment import geometry_at
from bevcli.workshop.calibration.estimates import CameraEstimate, Verdict, change_text
from bevcli.workshop.calibration.measure import Measurement

ROW_INCHES, WIDTH_INCHES = 2.9, 15.0
POINT, LINE = (255, 120, 90), (110, 200, 255)  # RGB
COLORS = {Verdict.FINE: "#7fd6a0", Verdict.CORRECTED: "#ffd640", Verdict.NOT_MEASURABLE: "#ff8080"}
HEADINGS = (
    "stated: matched points (red), their epipolar lines (blue)",
    "measured: ground grid (green), horizon (yellow)",
    "stated minus measured, 3 deviations",
)
MOST_SHOWN = 60  # matches of a camera
DEPTHS_M = np.geomspace(0.7, 300, 400)  # along the ray of a point
PIECE_PX = 30.0  # length of the shown piece of an epipolar line to each side


def write_sheet(path: Path, measurement: Measurement, cameras: tuple[CameraEstimate, ...]) -> None:
    """Write the sheet as a PNG, one row a camera. Raises OutputError."""
    height = ROW_INCHES * len(cameras) + 0.6
    figure = Figure(figsize=(WIDTH_INCHES, height), dpi=90, facecolor=PAPER)
    for left, text in zip((0.05, 0.43, 0.82), HEADINGS, strict=True):
        figure.text(left, 1 - 0.15 / height, text, color=INK, fontsize=11, va="top")
    for row, estimate in enumerate(cameras):
        bottom, size = 1 - (0.6 + ROW_INCHES * (row + 1)) / height, (ROW_INCHES - 0.45) / height
        for column in (0, 1):
            axes = figure.add_axes((0.01 + 0.38 * column, bottom + 0.1 / height, 0.37, size))
            _draw_image(axes, measurement, row, measured=column == 1)
        title = f"{estimate.camera}: {estimate.verdict.value}; {estimate.reason or change_text(estimate)}"
        figure.text(0.01, bottom + size + 0.13 / height, title, color=COLORS[estimate.verdict], fontsize=10)
        axes = figure.add_axes((0.82, bottom + 0.45 / height, 0.16, size - 0.4 / height))
        _draw_ellipse(axes, estimate)
    save(figure, path)


def _draw_image(axes: Axes, measurement: Measurement, index: int, *, measured: bool) -> None:
    """The image with the ground grid and the horizon, matched points, and pieces of their epipolar lines.

    Of a camera's pairs of images, that with most matches is shown.
    """
    axes.set(xticks=[], yticks=[])
    unknowns, views, matches = measurement.unknowns, measurement.views, measurement.matches
    x = measurement.solution.x * (1.0 if measured else 0.0)
    camera = replace(views.rig.cameras[index], ego_from_camera=unknowns.ego_from_camera(x)[index])
    counts = np.bincount(matches.group[matches.same], minlength=len(unknowns.groups))
    counts = np.where(unknowns.groups[:, 1] == index, counts, 0)
    group = int(np.argsort(counts)[-1])
    grey = np.full((camera.height, camera.width), 40, dtype=np.uint8)
    if counts[group]:
        grey = views.sides(views.groups()[group])[1].pixels
    canvas = np.repeat(grey[..., None], 3, axis=-1)
    draw_lines(canvas, ground_lines(camera), GROUND, 1)
    draw_lines(canvas, visible_runs(horizon(camera)), HORIZON, 2)
    mine = np.flatnonzero(matches.group == group) if counts[group] else np.zeros(0, dtype=np.int64)
    motion = geometry_at(unknowns, x).camera_b_from_camera_a[group]
    for match in mine[:: 1 + len(mine) // MOST_SHOWN]:
        point = matches.pixels_b[match]
        draw_lines(canvas, _epipolar_piece(camera, motion, matches.rays_a[match], point), LINE, 2)
        cv2.circle(canvas, (round(point[0]), round(point[1])), 4, POINT, -1, cv2.LINE_AA)
    axes.imshow(canvas)


def _epipolar_piece(camera: Camera, camera_b_from_camera_a: Array, ray: Array, point: Array) -> list[Array]:
    """The part of a ray's image that is nearest to a point, as lines (P, 2) in pixels."""
    points = DEPTHS_M[:, None] * ray @ camera_b_from_camera_a[:3, :3].T + camera_b_from_camera_a[:3, 3]
    pixels = camera.project(points)[0]
    distance = np.linalg.norm(pixels - point, axis=-1)
    if not np.isfinite(distance).any():
        return []
    nearest = pixels[np.nanargmin(distance)]
    near = np.linalg.norm(pixels - nearest, axis=-1) < PIECE_PX
    return visible_runs(np.where(near[:, None], pixels, np.nan))


def _draw_ellipse(axes: Axes, estimate: CameraEstimate) -> None:
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
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
    axes.set_xlabel("yaw, degrees", color=FAINT, fontsize=8, labelpad=1)
    axes.set_ylabel("pitch, degrees", color=FAINT, fontsize=8, labelpad=1)
    axes.tick_params(colors=FAINT, labelsize=7)
    axes.grid(color=FAINT, alpha=0.25)
