"""What all drawn images share: the sheet of `plot` and of a video, lines and texts in pixels, the map from above.

A canvas is (H, W, 3) uint8. Colours are BGR, but for the sheets of a rig, which are RGB.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from bevcli.geometry.object_classes import Color
from bevcli.geometry.transforms import Array
from bevcli.recording.blueprint import rows_of_largest_images

Canvas = NDArray[np.uint8]
ToCanvas = Callable[[Array], Array]  # points (K, 2) in the space of what is drawn -> (K, 2) pixels of a canvas
FONT = cv2.FONT_HERSHEY_SIMPLEX
FAR = 1e5  # pixels; what lies farther outside of a canvas is drawn there
WIDTH, HEIGHT = 1920, 640
BEV_SIDE = 640
CAMERAS_WIDTH = WIDTH - BEV_SIDE
CAMERAS_HEIGHT = 500
SMALL_TEXT, LABEL_SHARE = 0.36, 1 / 1800  # size of a label: the smallest one, and by the width of the image
BEV_MARGIN = 1.02  # of the range rings and the border of the grid
BACKGROUND = (25, 20, 18)
TEXT, WARNING = (225, 220, 215), (85, 70, 255)
UNTRAINED = "UNTRAINED WEIGHTS: boxes are meaningless"


def new_sheet() -> Canvas:
    """An empty sheet: cameras to the left, a legend below them, the map from above to the right."""
    return np.full((HEIGHT, WIDTH, 3), BACKGROUND, dtype=np.uint8)


def from_above(reach_m: float) -> ToCanvas:
    """Points (K, 2) of the BEV view, metres to the right and down from the vehicle -> pixels. reach_m: to each edge."""
    return lambda points: np.clip((points / reach_m + 1) * BEV_SIDE / 2, -FAR, FAR)


def draw_lines(
    canvas: Canvas, lines: Iterable[Array], color: Color, thickness: int = 1, opacity: float = 1, bits: int = 3
) -> None:
    """Draw lines (P, 2) in pixels, in place. bits: precision of their points, in bits of a pixel's fraction."""
    points = [np.round(line * (1 << bits)).astype(np.int32) for line in lines]
    layer = canvas if opacity == 1 else canvas.copy()
    cv2.polylines(layer, points, False, color, thickness, cv2.LINE_AA, bits)
    if opacity < 1:
        cv2.addWeighted(layer, opacity, canvas, 1 - opacity, 0, dst=canvas)


def draw_arrow(canvas: Canvas, start: Array, end: Array, color: Color) -> None:
    """Draw an arrow between two points (2,) in pixels."""
    cv2.arrowedLine(canvas, start.astype(int).tolist(), end.astype(int).tolist(), color, 1, cv2.LINE_AA, 0, 0.25)


def draw_text(
    canvas: Canvas, text: str, position: tuple[int, int], color: Color, size: float = 0.45, *, centered: bool = False
) -> None:
    """Draw a line of text.

    position: x, y, pixels, of the middle of its left edge, or of its centre if `centered`. color: BGR.
    """
    (width, height), _ = cv2.getTextSize(text, FONT, size, 1)
    left = position[0] - width // 2 if centered else position[0]
    bottom = position[1] + height // 2
    if centered:
        cv2.rectangle(canvas, (left - 2, bottom - height - 3), (left + width + 2, bottom + 3), (24, 20, 18), -1)
    cv2.putText(canvas, text, (left, bottom), FONT, size, color, 1, cv2.LINE_AA)


def draw_title(canvas: Canvas, camera: str, *, has_image: bool) -> None:
    """Draw the name of a camera into the corner of its image."""
    cv2.rectangle(canvas, (0, 0), (10 * len(camera) + 12, 22), BACKGROUND, -1)
    text, color = (camera, TEXT) if has_image else (f"{camera}: no image", WARNING)
    draw_text(canvas, text, (8, 11), color, 0.42)


def draw_entry(canvas: Canvas, position: tuple[int, int], color: Color, text: str) -> None:
    """Draw an entry of a legend. position: x, y of its left edge. color: RGB."""
    x, y = position
    cv2.rectangle(canvas, (x, y - 7), (x + 14, y + 7), color[::-1], -1)
    draw_text(canvas, text, (x + 24, y), TEXT)


@dataclass(frozen=True)
class Tile:
    """The rectangle of a camera's image in the video frame, pixels."""

    camera: str
    left: int
    top: int
    width: int
    height: int


def tiles_of(sizes: Mapping[str, ArrayLike], yaws: Mapping[str, float]) -> tuple[Tile, ...]:
    """The rectangles of cameras. sizes: width and height of their images. yaws: radians, in the ego frame."""
    whole = {name: np.asarray(size, dtype=np.float64) for name, size in sizes.items()}
    aspect = min(width / height for width, height in whole.values())
    rows = rows_of_largest_images(yaws, aspect, CAMERAS_WIDTH, CAMERAS_HEIGHT)
    cell = CAMERAS_WIDTH // max(len(row) for row in rows), CAMERAS_HEIGHT // len(rows)
    layout = []
    for r, row in enumerate(rows):
        indent = (CAMERAS_WIDTH - len(row) * cell[0]) // 2
        for c, name in enumerate(row):
            width, height = whole[name]
            scale = min(cell[0] / width, cell[1] / height)
            w, h = max(1, round(width * scale)), max(1, round(height * scale))
            left, top = indent + c * cell[0] + (cell[0] - w) // 2, r * cell[1] + (cell[1] - h) // 2
            layout.append(Tile(name, left, top, w, h))
    return tuple(layout)
