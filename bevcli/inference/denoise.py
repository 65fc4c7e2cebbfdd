"""Images with strong noise, as of a camera in the dark: the noise is measured, and smoothed by OpenCV's filters."""

from collections.abc import Callable

import cv2
import numpy as np

from bevcli.inference.auto_levels import Pixels

NOISY = 10.0  # standard deviation in grey levels; clean images have at most 1, falling snow up to 9
NOISE_OF_A_PIXEL = 30.0  # a blur whose standard deviation is one pixel is right for so much noise
SPIKE = 60  # grey levels; a pixel that differs so much from the median of its neighbours is wrong
SPIKES_SHARE = 0.05  # of the pixels; where more are wrong, a median filter is right
SIZE, GREY_LEVELS, DISTANCE = 9, 60.0, 3.0  # the bilateral filter: diameter and standard deviations
MEASURED_ROWS = 12


def denoised(pixels_bgr: Pixels, scale: float, levels: Callable[[Pixels], Pixels]) -> Pixels:
    """The image with other grey levels and without strong noise; with other grey levels only where it has little noise.

    Single wrong pixels are removed by a median filter. Other noise is blurred by a Gaussian as wide as the noise is
    strong, before the grey levels are measured, and then smoothed between edges by a bilateral filter.

    Args:
        pixels_bgr: (H, W, 3).
        scale: pixels of the network's input per pixel of the image. Where that is smaller, resizing averages the noise,
            and a noisy image is returned in its size.
        levels: gives an image ordinary grey levels, which makes the noise of a dark one stronger.
    """
    levelled, scale = levels(pixels_bgr), min(scale, 1.0)
    noise = measure_noise(levelled) * scale
    if noise < NOISY:
        return levelled
    size = max(round(pixels_bgr.shape[1] * scale), 1), max(round(pixels_bgr.shape[0] * scale), 1)
    small = cv2.resize(pixels_bgr, size, interpolation=cv2.INTER_AREA)
    median = cv2.medianBlur(small, 3)
    if np.mean(cv2.absdiff(small, median).max(axis=2) > SPIKE) > SPIKES_SHARE:
        return levels(np.asarray(cv2.medianBlur(median, 3), dtype=np.uint8))
    blurred = cv2.GaussianBlur(small, (0, 0), noise / NOISE_OF_A_PIXEL)
    smooth = cv2.bilateralFilter(levels(np.asarray(blurred, dtype=np.uint8)), SIZE, GREY_LEVELS, DISTANCE)
    return np.asarray(smooth, dtype=np.uint8)


def measure_noise(pixels_bgr: Pixels) -> float:
    """Standard deviation of the noise in grey levels, from every n-th row: as Immerkaer (1996), by the median.

    The differences of differences along rows and columns are zero on edges and ramps.
    """
    if min(pixels_bgr.shape[:2]) < 3:
        return 0.0
    rows = np.linspace(1, len(pixels_bgr) - 2, min(MEASURED_ROWS, len(pixels_bgr) - 2)).round().astype(int)
    above, here, below = (
        cv2.cvtColor(np.ascontiguousarray(pixels_bgr[rows + step]), cv2.COLOR_BGR2GRAY).astype(np.int16)
        for step in (-1, 0, 1)
    )
    along = above - 2 * here + below
    differences = along[:, :-2] - 2 * along[:, 1:-1] + along[:, 2:]
    return float(np.median(np.abs(differences))) / 0.6745 / 6  # the differences of noise of 1 have a deviation of 6
