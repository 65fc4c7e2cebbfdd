"""A camera's image with pillars, ground grid and horizon, as its calibration projects them."""

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, apply
from bevcli.recording.colors import Color, colormap
from bevcli.rig.coverage import pixels_in_image
from bevcli.rig.mounting import horizon

GRID_STEP_M, GRID_REACH_M = 5.0, 30.0
PILLAR_LINES_M = 25.0  # lines of farther pillars would be too dense
PILLAR_GRID = BevGrid(rows=20, columns=20)  # one pillar every 5.12 m; a denser grid would hide the image
LABELLED_M = (5.0, 10.0, 20.0, 40.0)
GROUND: Color = (120, 205, 140)
HORIZON: Color = (255, 214, 64)
PILLAR: Color = (235, 238, 245)
BACKDROP: Color = (44, 49, 58)
Pixels = NDArray[np.uint8]


def pillars_in(camera: Camera, ego_from_bev: Array) -> tuple[Array, Array, NDArray[np.uint8]]:
    """The M pillar points that are inside the camera's image, the farthest first. ego_from_bev: (4, 4).

    Returns pixels (M, 2), distances (M,) in metres, and RGB (M, 3) by height.
    """
    points = apply(ego_from_bev, PILLAR_GRID.pillars()).reshape(-1, 3)
    pixels = pixels_in_image(camera, points)
    distances = np.linalg.norm(points - camera.ego_from_camera[:3, 3], axis=1)
    colors = np.tile(height_colors(), (PILLAR_GRID.rows * PILLAR_GRID.columns, 1))
    order = np.argsort(-distances)
    order = order[np.isfinite(pixels[order]).all(-1)]
    return pixels[order], distances[order], colors[order]


def height_colors() -> NDArray[np.uint8]:
    """(Z, 3) RGB, the colours of a pillar's points, the lowest first."""
    return colormap(np.linspace(0.12, 0.9, PILLAR_GRID.pillar_points), "turbo")


def ground_lines(camera: Camera) -> list[Array]:
    """Lines (P, 2) in pixels of a 5 m grid on the ground around the ego origin, cut near the image border."""
    along = np.arange(-GRID_REACH_M, GRID_REACH_M + 0.05, 0.1)
    lines: list[Array] = []
    for offset in np.arange(-GRID_REACH_M, GRID_REACH_M + 0.1, GRID_STEP_M):
        across, flat = np.full_like(along, offset), np.zeros_like(along)
        for line in (np.stack([along, across, flat], axis=-1), np.stack([across, along, flat], axis=-1)):
            lines += visible_runs(_near_image(camera, line))
    return lines


def pillar_lines(camera: Camera, ego_from_bev: Array) -> list[Array]:
    """Lines (P, 2) in pixels from the lowest to the highest point of each pillar within 25 m."""
    pillars = PILLAR_GRID.pillars().reshape(-1, PILLAR_GRID.pillar_points, 3)
    low, high = pillars[:, :1], pillars[:, -1:]
    points = apply(ego_from_bev, low + np.linspace(0, 1, 24)[:, None] * (high - low))  # (Y X, 24, 3)
    near = np.linalg.norm(points[:, 0, :2] - camera.ego_from_camera[:2, 3], axis=-1) < PILLAR_LINES_M
    return [run for line in points[near] for run in visible_runs(_near_image(camera, line))]


def _near_image(camera: Camera, points_ego: Array) -> Array:
    """Points (P, 3) in the ego frame -> pixels (P, 2), NaN where they are more than an image size outside the image."""
    pixels, depth = camera.project_ego(points_ego)
    size = np.array([camera.width, camera.height])
    with np.errstate(invalid="ignore"):
        near = ((pixels > -size) & (pixels < 2 * size)).all(-1) & (depth > 0.1)
    return np.where(near[:, None], pixels, np.nan)


def visible_runs(pixels: Array) -> list[Array]:
    """A line (P, 2), split where it has NaN, into parts of two points or more."""
    seen = np.isfinite(pixels).all(-1)
    cuts = np.flatnonzero(np.diff(seen.astype(int))) + 1
    return [run for run in np.split(pixels, cuts) if len(run) > 1 and np.isfinite(run).all()]


def draw_overlay(camera: Camera, ego_from_bev: Array, image_bgr: Pixels | None, width: int) -> Pixels:
    """The camera's image with the overlay, (h, width, 3) RGB.

    image_bgr: (H, W, 3); a dark image is used where it is None. width: of the result, pixels.
    """
    shown = camera.scaled(width / camera.width)
    if image_bgr is None:
        canvas = np.full((shown.height, shown.width, 3), BACKDROP, dtype=np.uint8)
    else:
        resized = cv2.resize(image_bgr, (shown.width, shown.height), interpolation=cv2.INTER_AREA)
        canvas = (resized[..., ::-1] * 0.85).astype(np.uint8)  # a little darker, so that the overlay stands out
    _blend_lines(canvas, ground_lines(shown), GROUND, 0.55)
    _blend_lines(canvas, visible_runs(horizon(shown)), HORIZON, 0.9, thickness=2)
    _blend_lines(canvas, pillar_lines(shown, ego_from_bev), PILLAR, 0.35)
    for pixel, distance, color in zip(*pillars_in(shown, ego_from_bev), strict=True):
        radius = float(np.clip(60 / distance, 1.2, 6)) * (width / 800)
        center = tuple(np.round(pixel * 16).astype(int).tolist())
        cv2.circle(canvas, center, round(radius * 16), color.tolist(), -1, cv2.LINE_AA, 4)
    _draw_distances(canvas, shown)
    return canvas


def draw_lines(canvas: Pixels, lines: list[Array], color: Color, thickness: int) -> None:
    """Draw lines (P, 2) in pixels on an image (H, W, 3), in place."""
    points = [np.round(line * 16).astype(np.int32) for line in lines]
    cv2.polylines(canvas, points, False, color, thickness, cv2.LINE_AA, 4)


def _blend_lines(canvas: Pixels, lines: list[Array], color: Color, opacity: float, thickness: int = 1) -> None:
    layer = canvas.copy()
    draw_lines(layer, lines, color, thickness)
    cv2.addWeighted(layer, opacity, canvas, 1 - opacity, 0, dst=canvas)


def _draw_distances(canvas: Pixels, camera: Camera) -> None:
    """Label distances on the ground along the viewing direction, where the labels do not overlap."""
    ahead = np.array([np.cos(camera.yaw), np.sin(camera.yaw), 0.0])
    start = camera.ego_from_camera[:3, 3] * [1, 1, 0]
    font, size, last = cv2.FONT_HERSHEY_SIMPLEX, 0.5 * canvas.shape[1] / 800, np.inf
    for distance in LABELLED_M:
        pixel = pixels_in_image(camera, start + distance * ahead)
        if np.isfinite(pixel).all() and last - pixel[1] > 22:
            last = float(pixel[1])
            place = (round(pixel[0]), round(pixel[1]))
            for color, thickness in (((10, 12, 16), 4), ((240, 244, 248), 1)):
                cv2.putText(canvas, f"{distance:g} m", place, font, size, color, thickness, cv2.LINE_AA)
