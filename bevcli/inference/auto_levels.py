"""Grey levels of an image stretched to the full range, so that dark, pale and foggy images look alike to a model."""

import cv2
import numpy as np
from numpy.typing import NDArray

BLACK_SHARE, WHITE_SHARE = 0.005, 0.995  # of the pixels that are darker than the new black, and than the new white
MIDDLE = 0.45  # value that the median becomes, of 0 to 1
GAMMAS = (0.4, 1.3)  # least and largest exponent
SMALLEST_RANGE = 6  # grey levels; an image with less contrast shows nothing
SAMPLED_WIDTH = 256  # pixels; levels are measured on every n-th pixel, so that about so many are in a row


def auto_levels(pixels_bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 with the darkest grey values black, the brightest white and the median in the middle.

    All channels are changed by one table, so that hues stay. An image without contrast is returned as it is.
    """
    step = max(1, pixels_bgr.shape[1] // SAMPLED_WIDTH)
    grey = cv2.cvtColor(np.ascontiguousarray(pixels_bgr[::step, ::step]), cv2.COLOR_BGR2GRAY)
    below = np.cumsum(np.bincount(grey.ravel(), minlength=256)) / grey.size
    black, median, white = (int(level) for level in np.searchsorted(below, (BLACK_SHARE, 0.5, WHITE_SHARE)))
    if white - black < SMALLEST_RANGE:
        return pixels_bgr
    values = ((np.arange(256) - black) / (white - black)).clip(0, 1)
    gamma = np.clip(np.log(MIDDLE) / np.log(values[median].clip(0.001, 0.99)), *GAMMAS)
    return np.asarray(cv2.LUT(pixels_bgr, np.rint(255 * values**gamma).astype(np.uint8)), dtype=np.uint8)
