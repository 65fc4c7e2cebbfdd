"""Images in fog, in bad light or with strong noise, brought near to ordinary ones before they are resized.

Fog is recognised, and its light taken away, as by a dark channel (He et al. 2009). Grey levels of dark and pale images
are moved into the ranges that ordinary images have. Noise is measured, and smoothed by OpenCV's filters.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.model.config import ImageConfig

Pixels = NDArray[np.uint8]

BLACK_SHARE, WHITE_SHARE = 0.005, 0.995  # of the pixels that are darker than an image's black, and than its white
# Grey levels of ordinary images: three quarters of the rendered ones have such levels.
BLACK = 30.0  # at most
MEDIAN = (75.0, 115.0)
WHITE = 210.0  # at least
GAMMAS = (0.4, 2.5)  # least and largest exponent
SMALLEST_RANGE = 6  # grey levels; an image with less contrast shows nothing
SAMPLED_WIDTH = 256  # pixels; levels are measured on every n-th pixel, so that about so many are in a row

BLOCK = 16  # sampled pixels; fog leaves little contrast within a block
FOG_BLACK = 24  # grey level of the darkest pixels; fog makes them brighter
CONTRAST = 0.42  # of nine blocks in ten, as a share of the whole image's; that of fog is lower
UNEVENNESS = 0.38  # of the darkest grey levels around each place, in contrasts of a block; that of fog is larger
DARKEST = 23  # sampled pixels, around each place
SMOOTH = 8.0  # sampled pixels; fog has no edges
KEPT = 15.0  # grey levels that the darkest pixels keep

NOISY = 10.0  # standard deviation in grey levels; clean images have at most 1, falling snow up to 9
NOISE_OF_A_PIXEL = 30.0  # a blur whose standard deviation is one pixel is right for so much noise
SPIKE = 60  # grey levels; a pixel that differs so much from the median of its neighbours is wrong
SPIKES_SHARE = 0.05  # of the pixels; where more are wrong, a median filter is right
SIZE, GREY_LEVELS, DISTANCE = 9, 60.0, 3.0  # the bilateral filter: diameter and standard deviations
MEASURED_ROWS = 12


def repaired(pixels_bgr: Pixels, image: ImageConfig) -> Pixels:
    """(H, W, 3) without fog, with ordinary grey levels and without strong noise, as far as the model asks for it."""
    pixels_bgr = defogged(pixels_bgr) if image.defog else pixels_bgr
    if not image.denoise:
        return auto_levels(pixels_bgr) if image.auto_levels else pixels_bgr
    height, width = pixels_bgr.shape[:2]
    return denoised(pixels_bgr, min(image.size[0] / width, image.size[1] / height), auto=image.auto_levels)


def defogged(pixels_bgr: Pixels) -> Pixels:
    """(H, W, 3) without the light of the fog, which differs from place to place; an image without fog stays as it is.

    The grey levels then have less contrast than ordinary ones: `auto_levels` stretches them.
    """
    small = sampled(pixels_bgr)
    black, white = grey_levels(small, (BLACK_SHARE, WHITE_SHARE))
    rows, columns = small.shape[0] // BLOCK, small.shape[1] // BLOCK
    if black <= FOG_BLACK or min(rows, columns) == 0:
        return pixels_bgr
    grey = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY)
    blocks = grey[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK).swapaxes(1, 2)
    some = blocks.reshape(rows * columns, -1)[:, ::3].astype(np.int16)  # a third is enough
    places = [round(share * (some.shape[1] - 1)) for share in (0.05, 0.95)]
    dark, pale = np.partition(some, places, axis=1)[:, places].astype(np.float64).T
    contrast = np.percentile(pale - dark, 90)
    if contrast >= CONTRAST * (white - black):
        return pixels_bgr
    light = cv2.erode(small.min(axis=2), np.ones((DARKEST, DARKEST), np.uint8)).astype(np.float32)
    if light.std() <= UNEVENNESS * contrast:
        return pixels_bgr
    light = np.clip(cv2.GaussianBlur(light, (0, 0), SMOOTH) - KEPT, 0, None)
    light = cv2.resize(light, pixels_bgr.shape[1::-1], interpolation=cv2.INTER_LINEAR)[..., None]
    return np.clip(pixels_bgr - light, 0, 255).astype(np.uint8)


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


def denoised(pixels_bgr: Pixels, scale: float, *, auto: bool = False) -> Pixels:
    """The image with other grey levels and without strong noise; with other grey levels only where it has little noise.

    Single wrong pixels are removed by a median filter. Other noise is blurred by a Gaussian as wide as the noise is
    strong, before the grey levels are measured, and then smoothed between edges by a bilateral filter.

    Args:
        pixels_bgr: (H, W, 3).
        scale: pixels of the network's input per pixel of the image. Where that is smaller, resizing averages the noise,
            and a noisy image is returned in its size.
        auto: the image also gets ordinary grey levels, which makes the noise of a dark one stronger.
    """
    levels = auto_levels if auto else np.asarray
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
