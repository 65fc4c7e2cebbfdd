"""Grey images of cameras, brought to one width, and their texture."""

import os
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import Camera

WIDTH, MOST_ENLARGED = 1000, 2  # pixels: all images are brought to this width; largest factor
THREADS = min(os.cpu_count() or 1, 8)  # each needs about 150 MB while it finds features
DARKEST = 4  # grey levels of standard deviation; an image with less shows nothing
SMOOTHING, COARSE = 1.2, 35  # pixels: finer structure is noise, coarser is light and shade
FLAT = 1.0  # grey levels, a weaker structure is noise


@dataclass(frozen=True)
class GreyImage:
    """One camera's image at one time."""

    pixels: NDArray[np.uint8]  # (h, w) grey, at most WIDTH wide
    texture: NDArray[np.uint8]  # (h, w) fine structure with even contrast, without light and shade


def reduced(camera: Camera, width: int = WIDTH) -> Camera:
    """The camera of the reduced image. Its pixel (0, 0) is the centre of a larger pixel, so that coordinates shift."""
    width = min(width, MOST_ENLARGED * camera.width)
    size = (width, round(camera.height * width / camera.width))
    scaled = camera.scaled(size[0] / camera.width, size[1] / camera.height)
    scaled.intrinsics[:2, 2] += (np.array([scaled.width / camera.width, scaled.height / camera.height]) - 1) / 2
    return scaled


def grey_image(pixels_bgr: NDArray[np.uint8], camera: Camera) -> GreyImage | None:
    """An image (H, W, 3) as a camera of `reduced` sees it; None where it shows nothing."""
    size = (camera.width, camera.height)
    filtering = cv2.INTER_AREA if camera.width < pixels_bgr.shape[1] else cv2.INTER_CUBIC
    grey = cv2.cvtColor(pixels_bgr, cv2.COLOR_BGR2GRAY)
    pixels = cv2.resize(grey, size, interpolation=filtering) if grey.shape[::-1] != size else grey
    if pixels.std() < DARKEST:
        return None
    return GreyImage(np.asarray(pixels, dtype=np.uint8), texture(pixels))


def texture(pixels: NDArray[Any], seen: NDArray[np.bool_] | None = None) -> NDArray[np.uint8]:
    """The fine structure (h, w) of grey pixels (h, w) with even contrast; 128 where nothing is `seen` (h, w)."""
    smooth = cv2.GaussianBlur(pixels.astype(np.float32), (0, 0), SMOOTHING)
    fine = smooth - _mean(smooth, seen)
    contrast = np.sqrt(np.maximum(_mean(fine**2, seen), 0)) + FLAT
    levels = np.clip(128 + 40 * fine / contrast, 0, 255).astype(np.uint8)
    return levels if seen is None else np.where(seen, levels, np.uint8(128))


def _mean(values: NDArray[Any], seen: NDArray[np.bool_] | None) -> NDArray[Any]:
    """The mean around each pixel, of what is seen."""
    if seen is None:
        return cv2.blur(values, (COARSE, COARSE))
    share = seen.astype(np.float32)
    return cv2.blur(values * share, (COARSE, COARSE)) / np.maximum(cv2.blur(share, (COARSE, COARSE)), 1e-3)
