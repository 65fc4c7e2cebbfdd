"""What all drawn images share: lines in pixels.

A canvas is (H, W, 3) uint8. Colours are BGR, but for the sheets of a rig, which are RGB.
"""

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.object_classes import Color
from bevcli.geometry.transforms import Array

Canvas = NDArray[np.uint8]
FONT = cv2.FONT_HERSHEY_SIMPLEX


def draw_lines(
    canvas: Canvas, lines: Iterable[Array], color: Color, thickness: int = 1, opacity: float = 1, bits: int = 3
) -> None:
    """Draw lines (P, 2) in pixels, in place. bits: precision of their points, in bits of a pixel's fraction."""
    points = [np.round(line * (1 << bits)).astype(np.int32) for line in lines]
    layer = canvas if opacity == 1 else canvas.copy()
    cv2.polylines(layer, points, False, color, thickness, cv2.LINE_AA, bits)
    if opacity < 1:
        cv2.addWeighted(layer, opacity, canvas, 1 - opacity, 0, dst=canvas)
