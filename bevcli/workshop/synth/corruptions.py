"""Corruptions of images: RoboBEV's with its parameters (its weather is that of ImageNet-C), and more of ImageNet-C."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]
Level = int
# An image (H, W, 3) BGR, a level of the corruption's table, and random numbers -> the corrupted image.
ImageCorruption = Callable[[Pixels, Level, np.random.Generator], Pixels]

REFERENCE_WIDTH = 1600  # lengths in pixels are those of images of this width, nuScenes'; they scale with the width
# Level -> radius and standard deviation of the blur, pixels. The blur has 2 radius + 1 samples, one pixel apart.
MOTION_BLUR = {1: (10, 3.0), 2: (15, 5.0), 3: (15, 8.0), 4: (15, 12.0), 5: (20, 15.0)}
BITS = 5  # colour quantisation keeps this many bits minus the level


def motion_blur(pixels_bgr: Pixels, level: Level, random: np.random.Generator) -> Pixels:
    """The blur of a moving camera, in a direction of up to 45° from the horizontal."""
    radius, sigma = MOTION_BLUR[level]
    kernel = blur_kernel(radius, sigma, random.uniform(-45, 45), pixels_bgr.shape[1] / REFERENCE_WIDTH)
    blurred = cv2.filter2D(pixels_bgr.astype(np.float32), -1, kernel, borderType=cv2.BORDER_REPLICATE)
    return to_uint8(blurred / 255)


def blur_kernel(radius: int, sigma: float, angle_deg: float, scale: float) -> NDArray[np.float32]:
    """A kernel (K, K), K odd, for cv2.filter2D: half a Gaussian along a line that starts at the centre.

    The samples are placed between pixels by bilinear weights, so that a blur can be shorter than a pixel.

    radius: the line has 2 radius + 1 samples. sigma: of the Gaussian, in samples. angle_deg: direction of the line,
    clockwise in the image. scale: distance of the samples, pixels.
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
    """Each colour value keeps its highest 5 - level bits; the others are 0."""
    return pixels_bgr & np.uint8(0xFF << (8 - (BITS - level)) & 0xFF)


def to_uint8(values: NDArray[Any]) -> Pixels:
    """Values of 0 to 1 as 0 to 255, rounded; others are clipped."""
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)


# Level -> what is added to the value of HSV, which is in 0 to 1.
BRIGHTNESS = {1: 0.1, 2: 0.2, 3: 0.3, 4: 0.4, 5: 0.5}
LOW_LIGHT_GAMMA = 2.0
# Level -> brightest value, photons per unit of brightness, standard deviation of the read noise. The public code of
# RoboBEV counts these entries from 0: its severity 2 takes the third one, as here.
LOW_LIGHT = {0: (0.6, 600, 0.008), 1: (0.5, 250, 0.012), 2: (0.4, 120, 0.018), 3: (0.3, 50, 0.026), 4: (0.2, 30, 0.038)}


def brightness(pixels_bgr: Pixels, level: Level, random: np.random.Generator) -> Pixels:
    """A brighter image: the value of HSV is raised and clipped; hue and saturation stay."""
    return _with_hsv(pixels_bgr, 2, 1.0, BRIGHTNESS[level])


def _with_hsv(pixels_bgr: Pixels, channel: int, factor: float, added: float) -> Pixels:
    """The image with a channel of HSV multiplied and raised, and clipped to 0 to 1."""
    hsv = cv2.cvtColor(pixels_bgr.astype(np.float32) / 255, cv2.COLOR_BGR2HSV)
    hsv[..., channel] = np.clip(factor * hsv[..., channel] + added, 0, 1)
    return to_uint8(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR))


def low_light(pixels_bgr: Pixels, level: Level, random: np.random.Generator) -> Pixels:
    """A dark, noisy image: stretched, gamma 2, dimmed, with photon noise (Poisson) and read noise (Gaussian)."""
    brightest, photons, read_noise = LOW_LIGHT[level]
    values = pixels_bgr.astype(np.float32) / 255
    low, high = float(values.min()), float(values.max())
    stretched = (values - low) / max(high - low, 1e-6)
    dim = brightest * stretched**LOW_LIGHT_GAMMA
    noisy = np.clip(random.poisson(dim * photons) / photons, 0, 1)
    return to_uint8(noisy + read_noise * random.standard_normal(noisy.shape, dtype=np.float32))


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
    """Patches of fog of random shape over the whole image; without depth, so near things get as much as far ones."""
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

    size: a power of two. decay: each halving of the distance divides the random part by decay².
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
    """Falling flakes, blurred by their fall, over a whitened image."""
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


# Corruptions of ImageNet-C (Hendrycks and Dietterich, 2019) that no training here uses, so that they show how a model
# copes with what it has never seen. Level -> its published parameters.
DEFOCUS = {1: 3, 2: 4, 3: 6, 4: 8, 5: 10}  # radius of the disk, pixels
CONTRAST = {1: 0.4, 2: 0.3, 3: 0.2, 4: 0.1, 5: 0.05}  # share of the contrast that is left
IMPULSE_NOISE = {1: 0.03, 2: 0.06, 3: 0.09, 4: 0.17, 5: 0.27}  # share of the values that become 0 or 255
JPEG_QUALITY = {1: 25, 2: 18, 3: 15, 4: 10, 5: 7}
SATURATION = {1: (0.3, 0.0), 2: (0.1, 0.0), 3: (2.0, 0.0), 4: (5.0, 0.1), 5: (20.0, 0.2)}  # factor, and what is added


def defocus_blur(pixels_bgr: Pixels, level: Level, random: np.random.Generator) -> Pixels:
    """Each point becomes a disk, as out of focus."""
    radius = DEFOCUS[level] * pixels_bgr.shape[1] / REFERENCE_WIDTH
    reach = int(np.ceil(radius))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disk = np.clip(radius + 0.5 - np.hypot(x, y), 0, 1).astype(np.float32)
    blurred = cv2.filter2D(pixels_bgr.astype(np.float32), -1, disk / disk.sum(), borderType=cv2.BORDER_REPLICATE)
    return to_uint8(blurred / 255)


def low_contrast(pixels_bgr: Pixels, level: Level, random: np.random.Generator) -> Pixels:
    """Each channel comes nearer to its mean."""
    values = pixels_bgr.astype(np.float32) / 255
    mean = values.mean(axis=(0, 1))
    return to_uint8(mean + CONTRAST[level] * (values - mean))


def impulse_noise(pixels_bgr: Pixels, level: Level, random: np.random.Generator) -> Pixels:
    """Single values become 0 or 255."""
    draws = random.random(pixels_bgr.shape, dtype=np.float32)
    noisy = np.where(draws < IMPULSE_NOISE[level] / 2, 0, pixels_bgr)
    return np.where(draws > 1 - IMPULSE_NOISE[level] / 2, 255, noisy).astype(np.uint8)


def jpeg(pixels_bgr: Pixels, level: Level, random: np.random.Generator) -> Pixels:
    """A strong JPEG compression."""
    _, encoded = cv2.imencode(".jpg", pixels_bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY[level]])
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR), dtype=np.uint8)


def saturation(pixels_bgr: Pixels, level: Level, random: np.random.Generator) -> Pixels:
    """Pale (levels 1 and 2) or gaudy colours."""
    return _with_hsv(pixels_bgr, 1, *SATURATION[level])
