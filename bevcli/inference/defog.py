"""Images in fog: recognised, and freed of the light that the fog adds, as by a dark channel (He et al. 2009)."""

import cv2
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]

WIDTH = 256  # pixels of the small image on which fog is measured
BLOCK = 16  # pixels of the small image; fog leaves little contrast within a block
BLACK = 24.0  # grey level of the darkest pixels; fog makes them brighter
CONTRAST = 0.42  # of nine blocks in ten, as a share of the whole image's; that of fog is lower
UNEVENNESS = 0.38  # of the darkest grey levels around each place, in contrasts of a block; that of fog is larger
DARKEST = 23  # pixels of the small image, around each place
SMOOTH = 8.0  # pixels of the small image; fog has no edges
KEPT = 15.0  # grey levels that the darkest pixels keep


def defogged(pixels_bgr: Pixels) -> Pixels:
    """(H, W, 3) without the light of the fog, which differs from place to place; an image without fog stays as it is.

    The grey levels then have less contrast than ordinary ones: `auto_levels` stretches them.
    """
    height, width = pixels_bgr.shape[:2]
    size = min(WIDTH, width), max(round(height * min(WIDTH, width) / width), 1)
    small = cv2.resize(pixels_bgr, size, interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY)
    black, white = np.percentile(grey, (0.5, 99.5))
    if black <= BLACK or min(size) < BLOCK:
        return pixels_bgr
    rows, columns = size[1] // BLOCK, size[0] // BLOCK
    blocks = grey[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK).swapaxes(1, 2)
    dark, bright = np.percentile(blocks.reshape(rows * columns, -1), (5, 95), axis=1)
    contrast = np.percentile(bright - dark, 90)
    light = cv2.erode(small.min(axis=2), np.ones((DARKEST, DARKEST), np.uint8)).astype(np.float32)
    if contrast >= CONTRAST * (white - black) or light.std() <= UNEVENNESS * contrast:
        return pixels_bgr
    light = np.clip(cv2.GaussianBlur(light, (0, 0), SMOOTH) - KEPT, 0, None)
    light = cv2.resize(light, (width, height), interpolation=cv2.INTER_LINEAR)[..., None]
    return np.clip(pixels_bgr - light, 0, 255).astype(np.uint8)
