"""Draws the 2D entities of a recording (lines, arrows, labels) with OpenCV, without viewer, GPU or screen."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.transforms import Array
from bevcli.viewer.recording_reader import RecordedFrame

Canvas = NDArray[np.uint8]
ToCanvas = Callable[[Array], Array]  # points (K, 2) in the space of an entity -> (K, 2) pixels of a canvas
FONT = cv2.FONT_HERSHEY_SIMPLEX
SUBPIXEL_BITS = 3


def draw_strips(canvas: Canvas, frame: RecordedFrame, entity: str, to_canvas: ToCanvas, thickness: int = 1) -> None:
    """Draws the line strips of an entity."""
    strips = frame.values(entity, "LineStrips2D:strips")
    colors = entity_colors(frame, entity, "LineStrips2D:colors", len(strips))
    for strip, color in zip(strips, colors, strict=True):
        points = _fixed_point(to_canvas(np.array(strip)))
        cv2.polylines(canvas, [points], False, color, thickness, cv2.LINE_AA, SUBPIXEL_BITS)


def draw_arrows(canvas: Canvas, frame: RecordedFrame, entity: str, to_canvas: ToCanvas) -> None:
    """Draws the 2D arrows of an entity."""
    starts = frame.array(entity, "Arrows2D:origins", 2)
    ends = starts + frame.array(entity, "Arrows2D:vectors", 2)
    colors = entity_colors(frame, entity, "Arrows2D:colors", len(starts))
    for start, end, color in zip(to_canvas(starts), to_canvas(ends), colors, strict=True):
        cv2.arrowedLine(canvas, start.astype(int).tolist(), end.astype(int).tolist(), color, 1, cv2.LINE_AA, 0, 0.25)


def draw_labels(canvas: Canvas, frame: RecordedFrame, entity: str, to_canvas: ToCanvas, size: float = 0.4) -> None:
    """Draws the labels of an entity as text on a dark background, centred on the labelled points."""
    positions = to_canvas(frame.array(entity, "Points2D:positions", 2))
    colors = entity_colors(frame, entity, "Points2D:colors", len(positions))
    for text, (x, y), color in zip(frame.values(entity, "Points2D:labels"), positions, colors, strict=False):
        draw_text(canvas, text, (int(x), int(y)), color, size, centered=True)


def draw_text(
    canvas: Canvas,
    text: str,
    position: tuple[int, int],
    color: tuple[int, int, int],
    size: float = 0.45,
    *,
    centered: bool = False,
) -> None:
    """Draws a line of text.

    position: x, y, pixels, of the middle of its left edge, or of its centre if `centered`. color: BGR.
    """
    (width, height), _ = cv2.getTextSize(text, FONT, size, 1)
    left = position[0] - width // 2 if centered else position[0]
    bottom = position[1] + height // 2
    if centered:
        cv2.rectangle(canvas, (left - 2, bottom - height - 3), (left + width + 2, bottom + 3), (24, 20, 18), -1)
    cv2.putText(canvas, text, (left, bottom), FONT, size, color, 1, cv2.LINE_AA)


def entity_colors(frame: RecordedFrame, entity: str, component: str, count: int) -> list[tuple[int, int, int]]:
    """`count` colours, BGR. One recorded colour is repeated; without a recorded colour all are white."""
    packed = frame.values(entity, component) or [0xFFFFFFFF]
    colors = [((c >> 8) & 255, (c >> 16) & 255, (c >> 24) & 255) for c in packed]
    return colors if len(colors) == count else colors[:1] * count


def recorded_image(frame: RecordedFrame, entity: str) -> Canvas | None:
    """The uncompressed image of an entity, (H, W, 3) uint8 BGR; None if it has none."""
    formats = frame.values(entity, "Image:format")
    if not formats:
        return None
    pixels = np.frombuffer(frame.blob(entity, "Image:buffer"), dtype=np.uint8)
    return pixels.reshape(formats[0]["height"], formats[0]["width"], 3)[..., ::-1]


def _fixed_point(points: Array) -> NDArray[np.int32]:
    return np.round(np.clip(points, -1e5, 1e5) * (1 << SUBPIXEL_BITS)).astype(np.int32)
