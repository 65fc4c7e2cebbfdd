"""Fog and snow, with the parameters of RoboBEV, which are those of the package imagecorruptions (ImageNet-C)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.robustness.processing import REFERENCE_WIDTH, Level, Pixels, blur_kernel, to_uint8

# Level -> amount of fog, and how quickly the fog's structure gets finer and fainter.
FOG = {1: (1.5, 2.0), 2: (2.0, 2.0), 3: (2.5, 1.7), 4: (2.5, 1.5), 5: (3.0, 1.4)}
FOG_MAP_SIZE = 512  # cells per side of the fog's map; finer structure is fainter than a grey level
FOG_VISIBLE = 400  # cells along the image's longer side: as 1600 pixels in a map of 2048
# Level -> mean and standard deviation of the flakes' noise, their zoom, the threshold, radius and standard deviation of
# their blur (pixels), and the share of the image that is not whitened.
SNOW = {
    1: (0.1, 0.3, 3.0, 0.5, 10, 4.0, 0.8),
    2: (0.2, 0.3, 2.0, 0.5, 12, 4.0, 0.7),
    3: (0.55, 0.3, 4.0, 0.9, 12, 8.0, 0.7),
    4: (0.55, 0.3, 4.5, 0.85, 12, 8.0, 0.65),
    5: (0.55, 0.3, 2.5, 0.85, 12, 12.0, 0.55),
}


def fog(pixels_bgr: Pixels, level: Level, random: np.random.Generator) -> Pixels:
    """Patches of fog of random shape over the whole image. It does not know depth: near things get as much as far ones.

    pixels_bgr: (H, W, 3). level: of FOG.
    """
    amount, decay = FOG[level]
    height, width = pixels_bgr.shape[:2]
    scale = FOG_VISIBLE / max(height, width)
    visible = fractal(FOG_MAP_SIZE, decay, random)[: max(round(height * scale), 1), : max(round(width * scale), 1)]
    density = cv2.resize(visible, (width, height), interpolation=cv2.INTER_LINEAR)
    values = pixels_bgr.astype(np.float32) / 255
    brightest = float(values.max())
    return to_uint8((values + amount * density[..., None]) * (brightest / (brightest + amount)))


def fractal(size: int, decay: float, random: np.random.Generator) -> NDArray[np.float32]:
    """(size, size) a random map of 0 to 1 by the diamond-square method; its opposite sides fit together.

    Args:
        size: a power of two.
        decay: each halving of the distance divides the random part by decay².
    """
    grid = np.zeros((1, 1))
    amplitude = 1.0
    while len(grid) < size:
        finer = np.empty((2 * len(grid), 2 * len(grid)))
        noise = random.uniform(-amplitude, amplitude, (3, *grid.shape))
        right, below = np.roll(grid, -1, axis=1), np.roll(grid, -1, axis=0)
        centers = (grid + right + below + np.roll(right, -1, axis=0)) / 4 + noise[0]
        finer[::2, ::2] = grid
        finer[1::2, 1::2] = centers
        finer[::2, 1::2] = (grid + right + centers + np.roll(centers, 1, axis=0)) / 4 + noise[1]
        finer[1::2, ::2] = (grid + below + centers + np.roll(centers, 1, axis=1)) / 4 + noise[2]
        grid = finer
        amplitude /= decay**2
    grid -= grid.min()
    return (grid / max(grid.max(), 1e-12)).astype(np.float32)


def snow(pixels_bgr: Pixels, level: Level, random: np.random.Generator) -> Pixels:
    """Falling flakes, blurred by their fall, over a whitened image.

    pixels_bgr: (H, W, 3). level: of SNOW.
    """
    mean, deviation, zoom, threshold, radius, sigma, kept = SNOW[level]
    height, width = pixels_bgr.shape[:2]
    scale = width / REFERENCE_WIDTH
    large = (REFERENCE_WIDTH, max(round(height / scale), 1))
    small = tuple(int(np.ceil(side / zoom)) for side in large)
    noise = (mean + deviation * random.standard_normal(small[::-1])).astype(np.float32)
    flakes = cv2.resize(noise, large, interpolation=cv2.INTER_LINEAR)
    flakes = np.clip(np.where(flakes < threshold, 0, flakes), 0, 1)
    flakes = cv2.resize(flakes, (width, height), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    kernel = blur_kernel(radius, sigma, random.uniform(-135, -45), scale)
    flakes = cv2.filter2D(flakes, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    values = pixels_bgr.astype(np.float32) / 255
    grey = cv2.cvtColor(values, cv2.COLOR_BGR2GRAY)[..., None]
    whitened = kept * values + (1 - kept) * np.maximum(values, 1.5 * grey + 0.5)
    return to_uint8(whitened + (flakes + flakes[::-1, ::-1])[..., None])
