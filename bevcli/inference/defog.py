"""Images in fog: recognised, and freed of the light that the fog adds, as by a dark channel (He et al. 2009)."""

import cv2
import numpy as np

from bevcli.inference.auto_levels import BLACK_SHARE, WHITE_SHARE, Pixels, grey_levels, sampled

BLOCK = 16  # sampled pixels; fog leaves little contrast within a block
BLACK = 24  # grey level of the darkest pixels; fog makes them brighter
CONTRAST = 0.42  # of nine blocks in ten, as a share of the whole image's; that of fog is lower
UNEVENNESS = 0.38  # of the darkest grey levels around each place, in contrasts of a block; that of fog is larger
DARKEST = 23  # sampled pixels, around each place
SMOOTH = 8.0  # sampled pixels; fog has no edges
KEPT = 15.0  # grey levels that the darkest pixels keep


def defogged(pixels_bgr: Pixels) -> Pixels:
    """(H, W, 3) without the light of the fog, which differs from place to place; an image without fog stays as it is.

    The grey levels then have less contrast than ordinary ones: `auto_levels` stretches them.
    """
    small = sampled(pixels_bgr)
    black, white = grey_levels(small, (BLACK_SHARE, WHITE_SHARE))
    rows, columns = small.shape[0] // BLOCK, small.shape[1] // BLOCK
    if black <= BLACK or min(rows, columns) == 0:
        return pixels_bgr
    grey = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY)
    blocks = grey[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK).swapaxes(1, 2)
    ordered = np.sort(blocks.reshape(rows * columns, -1)[:, ::3], axis=1).astype(np.float64)  # a third is enough
    last = ordered.shape[1] - 1
    contrast = np.percentile(ordered[:, round(0.95 * last)] - ordered[:, round(0.05 * last)], 90)
    if contrast >= CONTRAST * (white - black):
        return pixels_bgr
    light = cv2.erode(small.min(axis=2), np.ones((DARKEST, DARKEST), np.uint8)).astype(np.float32)
    if light.std() <= UNEVENNESS * contrast:
        return pixels_bgr
    light = np.clip(cv2.GaussianBlur(light, (0, 0), SMOOTH) - KEPT, 0, None)
    light = cv2.resize(light, pixels_bgr.shape[1::-1], interpolation=cv2.INTER_LINEAR)[..., None]
    return np.clip(pixels_bgr - light, 0, 255).astype(np.uint8)
