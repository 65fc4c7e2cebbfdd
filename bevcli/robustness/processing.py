"""Motion blur and colour quantisation, with the parameters of RoboBEV, and what all image corruptions share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]
Level = int
ImageCorruption = Callable[[Pixels, Level, np.random.Generator], Pixels]

REFERENCE_WIDTH = 1600  # lengths in pixels are those of images of this width, nuScenes'; they scale with the width
# Level -> radius and standard deviation of the blur, pixels. The blur has 2 radius + 1 samples, one pixel apart.
MOTION_BLUR = {1: (10, 3.0), 2: (15, 5.0), 3: (15, 8.0), 4: (15, 12.0), 5: (20, 15.0)}
BITS = 5  # colour quantisation keeps this many bits minus the level


def motion_blur(pixels_bgr: Pixels, level: Level, random: np.random.Generator) -> Pixels:
    """The blur of a moving camera, in a direction of up to 45° from the horizontal.

    pixels_bgr: (H, W, 3). level: of MOTION_BLUR.
    """
    radius, sigma = MOTION_BLUR[level]
    kernel = blur_kernel(radius, sigma, random.uniform(-45, 45), pixels_bgr.shape[1] / REFERENCE_WIDTH)
    blurred = cv2.filter2D(pixels_bgr.astype(np.float32), -1, kernel, borderType=cv2.BORDER_REPLICATE)
    return to_uint8(blurred / 255)


def blur_kernel(radius: int, sigma: float, angle_deg: float, scale: float) -> NDArray[np.float32]:
    """A kernel (K, K), K odd, for cv2.filter2D: half a Gaussian along a line that starts at the centre.

    The samples are placed between pixels by bilinear weights, so that a blur can be shorter than a pixel.

    Args:
        radius: the line has 2 radius + 1 samples.
        sigma: standard deviation of the Gaussian, in samples.
        angle_deg: direction of the line, clockwise in the image.
        scale: distance of the samples, pixels.
    """
    steps = np.arange(2 * radius + 1)
    weights = np.exp(-(steps**2) / (2 * sigma**2))
    half = int(np.ceil(steps[-1] * scale)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1))
    x, y = (half + scale * steps * part(np.radians(angle_deg)) for part in (np.cos, np.sin))
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    for dy in (0, 1):
        for dx in (0, 1):
            share = (1 - np.abs(x - left - dx)) * (1 - np.abs(y - top - dy))
            np.add.at(kernel, (top + dy, left + dx), weights * share)
    return (kernel / kernel.sum()).astype(np.float32)


def color_quantisation(pixels_bgr: Pixels, level: Level, random: np.random.Generator) -> Pixels:
    """Each colour value keeps its highest 5 - level bits; the others are 0.

    pixels_bgr: (H, W, 3). level: 1 to 4. random: not used.
    """
    mask = 0xFF & ~((1 << (8 - (BITS - level))) - 1)
    return pixels_bgr & np.uint8(mask)


def to_uint8(values: NDArray[Any]) -> Pixels:
    """Values of 0 to 1 as 0 to 255, rounded; others are clipped."""
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
