"""Draws one frame of a video: all cameras with their boxes, the BEV to the right, a legend below."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np

from bevcli.frame import MAP_CLASSES
from bevcli.geometry.transforms import Array
from bevcli.recording import entities
from bevcli.recording.camera_layout import rows_by_yaw
from bevcli.recording.colors import class_color, map_colors
from bevcli.viewer.camera_images import CameraImages
from bevcli.viewer.flat_drawing import (
    Canvas,
    ToCanvas,
    draw_arrows,
    draw_labels,
    draw_strips,
    draw_text,
    recorded_image,
)
from bevcli.viewer.recording_reader import RecordedFrame

WIDTH, HEIGHT = 1920, 640
BEV_SIDE = 640
CAMERAS_WIDTH = WIDTH - BEV_SIDE
CAMERAS_HEIGHT = 500
BEV_RANGE_M = 50.0  # from the vehicle to each edge of the BEV view, in recordings without range rings
BEV_MARGIN = 1.02  # of the range rings and the border of the grid
BACKGROUND = (25, 20, 18)  # BGR, as all colours of the video
BELOW_BOXES = (
    entities.BEV_GROUND_TRUTH, entities.BEV_MISSED, entities.BEV_TRACKS, entities.BEV_FALSE, entities.BEV_DUPLICATES
)  # fmt: skip
TEXT, WARNING = (225, 220, 215), (85, 70, 255)


@dataclass(frozen=True)
class Tile:
    """The rectangle of a camera's image in the video frame, pixels."""

    camera: str
    left: int
    top: int
    width: int
    height: int


def tiles(rows: tuple[tuple[str, ...], ...], sizes: dict[str, tuple[int, int]]) -> tuple[Tile, ...]:
    """The rectangles of the cameras, by rows. sizes: (width, height) of the images by camera, pixels."""
    cell = CAMERAS_WIDTH // max(len(row) for row in rows), CAMERAS_HEIGHT // len(rows)
    layout = []
    for r, row in enumerate(rows):
        indent = (CAMERAS_WIDTH - len(row) * cell[0]) // 2
        for c, name in enumerate(row):
            width, height = sizes[name]
            scale = min(cell[0] / width, cell[1] / height)
            w, h = round(width * scale), round(height * scale)
            left, top = indent + c * cell[0] + (cell[0] - w) // 2, r * cell[1] + (cell[1] - h) // 2
            layout.append(Tile(name, left, top, w, h))
    return tuple(layout)


def camera_rows_of(frame: RecordedFrame) -> tuple[tuple[str, ...], ...]:
    """The cameras of a recording in rows, in the same order as in the viewer."""
    from_world = _rotation(frame, entities.EGO).T
    yaws = {}
    for name in frame.values(entities.RUN, "camera_names"):
        ahead = from_world @ _rotation(frame, entities.camera(name))[:, 2]
        yaws[name] = float(np.arctan2(ahead[1], ahead[0]))
    return rows_by_yaw(yaws)


def draw_frame(frame: RecordedFrame, layout: tuple[Tile, ...], images: CameraImages) -> Canvas:
    """The video frame, (HEIGHT, WIDTH, 3) uint8 BGR.

    layout: where each camera's image goes. images: decodes them; frames must come in order.
    """
    canvas = np.full((HEIGHT, WIDTH, 3), BACKGROUND, dtype=np.uint8)
    for tile in layout:
        image = images.image(frame, tile.camera)
        _draw_camera(canvas[tile.top : tile.top + tile.height, tile.left : tile.left + tile.width], frame, tile, image)
    _draw_bev(canvas[:, CAMERAS_WIDTH:], frame)
    _draw_legend(canvas[CAMERAS_HEIGHT:, :CAMERAS_WIDTH], frame)
    return canvas


def _draw_camera(canvas: Canvas, frame: RecordedFrame, tile: Tile, image: Canvas | None) -> None:
    width, height = frame.array(entities.camera(tile.camera), "Pinhole:resolution", 2)[0]
    if image is not None:
        canvas[:] = cv2.resize(image, (tile.width, tile.height), interpolation=cv2.INTER_AREA)
    scale = np.array([tile.width / width, tile.height / height])

    def to_canvas(points: Array) -> Array:
        return points * scale

    boxes = entities.overlay(tile.camera, "boxes")
    draw_strips(canvas, frame, entities.overlay(tile.camera, "ground_truth"), to_canvas)
    draw_strips(canvas, frame, boxes, to_canvas)
    draw_labels(canvas, frame, f"{boxes}/labels", to_canvas, 0.36)
    cv2.rectangle(canvas, (0, 0), (10 * len(tile.camera) + 12, 22), BACKGROUND, -1)
    draw_text(
        canvas,
        tile.camera if image is not None else f"{tile.camera}: no image",
        (8, 11),
        TEXT if image is not None else WARNING,
        0.42,
    )


def _draw_bev(canvas: Canvas, frame: RecordedFrame) -> None:
    rings = [np.abs(strip).max() for strip in frame.values(entities.BEV_RINGS, "LineStrips2D:strips")]
    reach = BEV_MARGIN * max(rings) if rings else BEV_RANGE_M

    def to_canvas(points: Array) -> Array:
        return (points / reach + 1) * BEV_SIDE / 2

    segmentation = recorded_image(frame, entities.BEV_SEGMENTATION)
    if segmentation is not None:
        _draw_placed(canvas, frame, entities.BEV_SEGMENTATION, segmentation, to_canvas)
    draw_strips(canvas, frame, entities.BEV_RINGS, to_canvas)
    draw_labels(canvas, frame, f"{entities.BEV_RINGS}/labels", to_canvas, 0.35)
    for entity in BELOW_BOXES:
        draw_strips(canvas, frame, entity, to_canvas)
    draw_strips(canvas, frame, entities.BEV_BOXES, to_canvas, 2)
    draw_arrows(canvas, frame, entities.BEV_VELOCITY, to_canvas)
    draw_strips(canvas, frame, entities.BEV_VEHICLE, to_canvas, 2)


def _draw_placed(canvas: Canvas, frame: RecordedFrame, entity: str, image: Canvas, to_canvas: ToCanvas) -> None:
    start = frame.array(entity, "Transform3D:translation", 3)[0, :2]
    extent = frame.array(entity, "Transform3D:scale", 3)[0, :2] * image.shape[1::-1]
    left, top = to_canvas(start).astype(int)
    right, bottom = to_canvas(start + extent).astype(int)
    x0, y0, x1, y1 = max(left, 0), max(top, 0), min(right, BEV_SIDE), min(bottom, BEV_SIDE)
    whole = cv2.resize(image, (right - left, bottom - top), interpolation=cv2.INTER_NEAREST)
    canvas[y0:y1, x0:x1] = whole[y0 - top : y1 - top, x0 - left : x1 - left]


def _draw_legend(canvas: Canvas, frame: RecordedFrame) -> None:
    title = "".join(frame.values(entities.RUN, "title"))
    scene = "".join(frame.values(entities.EGO, "scene"))
    speed = "".join(frame.values(entities.SPEED, "Points3D:labels"))
    draw_text(canvas, f"{title}   {scene}   frame {frame.index}   {speed}", (16, 24), TEXT, 0.6)
    note = "".join(frame.values(entities.RUN, "note"))
    if any(frame.values(entities.RUN, "untrained")):
        note = "UNTRAINED WEIGHTS: boxes are meaningless"
    draw_text(canvas, note, (CAMERAS_WIDTH - 480, 24), WARNING, 0.6)
    names = frame.values(entities.RUN, "class_names")
    counts = Counter(frame.values(entities.BOXES, "name"))
    for index, name in enumerate(names):
        red, green, blue = class_color(name, index)
        x, y = 16 + 250 * (index % 5), 60 + 32 * (index // 5)
        cv2.rectangle(canvas, (x, y - 7), (x + 14, y + 7), (blue, green, red), -1)
        draw_text(canvas, f"{name.replace('_', ' ')} {counts[name]}", (x + 24, y), TEXT)
    if frame.has(entities.BEV_SEGMENTATION, "Image:buffer"):
        # Recordings of version 0.1.0 do not name their classes, which are those of the segmentation head.
        _draw_map_legend(canvas, frame.values(entities.RUN, "map_classes") or list(MAP_CLASSES))


def _draw_map_legend(canvas: Canvas, classes: list[str]) -> None:
    width = min(250, (CAMERAS_WIDTH - 16) // len(classes))
    for index, (name, (red, green, blue)) in enumerate(map_colors(classes).items()):
        x, y = 16 + width * index, 60 + 32 * 2
        cv2.rectangle(canvas, (x, y - 7), (x + 14, y + 7), (blue, green, red), -1)
        draw_text(canvas, f"map: {name.replace('_', ' ')}", (x + 24, y), TEXT)


def _rotation(frame: RecordedFrame, entity: str) -> Array:
    columns = frame.array(entity, "Transform3D:mat3x3", 9)
    return columns[0].reshape(3, 3).T if len(columns) else np.eye(3)  # rerun stores matrices by columns
