"""Grey levels of dark, pale and foggy images, moved into the ranges that ordinary images have."""

import cv2
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]

BLACK_SHARE, WHITE_SHARE = 0.005, 0.995  # of the pixels that are darker than an image's black, and than its white
# Grey levels of ordinary images: three quarters of the rendered ones have such levels.
BLACK = 30.0  # at most
MEDIAN = (75.0, 115.0)
WHITE = 210.0  # at least
GAMMAS = (0.4, 2.5)  # least and largest exponent
SMALLEST_RANGE = 6  # grey levels; an image with less contrast shows nothing
SAMPLED_WIDTH = 256  # pixels; levels are measured on every n-th pixel, so that about so many are in a row


def auto_levels(pixels_bgr: Pixels) -> Pixels:
    """(H, W, 3) uint8 whose black, white and median grey are as near to the image's own as the ranges above allow.

    An ordinary image, and one without contrast, is returned as it is. All channels are changed by one table, so that
    hues stay.
    """
    black, median, white = grey_levels(sampled(pixels_bgr), (BLACK_SHARE, 0.5, WHITE_SHARE))
    ordinary = black <= BLACK and MEDIAN[0] <= median <= MEDIAN[1] and white >= WHITE
    if ordinary or white - black < SMALLEST_RANGE:
        return pixels_bgr
    low, high = min(black, BLACK), max(white, WHITE)
    stretched = ((np.arange(256) - black) * (high - low) / (white - black) + low).clip(0, 255) / 255
    middle, dark, pale = np.clip(stretched[median], 0.004, 0.99), MEDIAN[0] / 255, MEDIAN[1] / 255
    gamma = np.clip(np.log(np.clip(middle, dark, pale)) / np.log(middle), *GAMMAS)
    return np.asarray(cv2.LUT(pixels_bgr, np.rint(255 * stretched**gamma).astype(np.uint8)), dtype=np.uint8)


def sampled(pixels_bgr: Pixels) -> Pixels:
    """Every n-th pixel of an image (H, W, 3), so that about SAMPLED_WIDTH are in a row."""
    step = min(max(1, pixels_bgr.shape[1] // SAMPLED_WIDTH), len(pixels_bgr))
    height, width = pixels_bgr.shape[0] // step, pixels_bgr.shape[1] // step
    whole = pixels_bgr[: height * step, : width * step]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_NEAREST), dtype=np.uint8)


def grey_levels(pixels_bgr: Pixels, shares: tuple[float, ...]) -> tuple[int, ...]:
    """The grey levels that these shares of the pixels (H, W, 3) do not exceed."""
    grey = cv2.cvtColor(pixels_bgr, cv2.COLOR_BGR2GRAY)
    below = np.cumsum(np.bincount(grey.ravel(), minlength=256)) / grey.size
    return tuple(int(level) for level in np.searchsorted(below, shares))
