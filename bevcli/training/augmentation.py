"""Image augmentation: photometric distortion and grid mask. Boxes, maps and calibration stay as they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bevcli.frame import CameraImage, Frame

MAX_BRIGHTNESS = 32.0  # added to pixel values of 0 to 255
CONTRAST_RANGE = SATURATION_RANGE = (0.5, 1.5)  # factors
MAX_HUE_DEG = 18.0


@dataclass(frozen=True)
class AugmentationConfig:
    """The [training.augmentation] table.

    Attributes:
        photometric: probability (0 to 1) of each distortion of an image: brightness, contrast, saturation, hue.
        grid_mask: probability (0 to 1) that a grid of grey squares covers an image.
    """

    photometric: float = 0.5
    grid_mask: float = 0.7

    def __post_init__(self) -> None:
        if not (0 <= self.photometric <= 1 and 0 <= self.grid_mask <= 1):
            raise ValueError("photometric and grid_mask are probabilities, from 0 to 1")


def distort_images(frame: Frame, probability: float, random: np.random.Generator) -> Frame:
    """A copy of the frame with `distort` applied to each image."""
    if probability == 0:
        return frame
    images: Mapping[str, CameraImage] = {
        name: replace(image, pixels_bgr=distort(image.pixels_bgr, probability, random))
        for name, image in frame.images.items()
    }
    return replace(frame, images=images)


def distort(pixels_bgr: NDArray[np.uint8], probability: float, random: np.random.Generator) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 with brightness, contrast, saturation and hue changed, each with the given probability."""
    applied = random.random(4) < probability
    brightness = random.uniform(-MAX_BRIGHTNESS, MAX_BRIGHTNESS) * applied[0]
    contrast, saturation = random.uniform(*CONTRAST_RANGE), random.uniform(*SATURATION_RANGE)
    hue_deg = random.uniform(-MAX_HUE_DEG, MAX_HUE_DEG) * applied[3]
    pixels = (pixels_bgr.astype(np.float32) + np.float32(brightness)) * np.float32(contrast if applied[1] else 1)
    if applied[2] or applied[3]:
        hsv = cv2.cvtColor(pixels.clip(0, 255) / np.float32(255), cv2.COLOR_BGR2HSV)
        hsv[..., 0] = (hsv[..., 0] + hue_deg) % 360
        hsv[..., 1] = (hsv[..., 1] * (saturation if applied[2] else 1)).clip(0, 1)
        pixels = cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR) * np.float32(255)
    return pixels.clip(0, 255).astype(np.uint8)


def mask_images(images: Tensor, probability: float, random: np.random.Generator) -> None:
    """Covers normalised images (..., 3, H, W) with a grid of grey squares in place, each with the given probability."""
    for image in images.flatten(0, -4):
        if random.random() < probability:
            height, width = image.shape[-2:]
            period = int(random.integers(2, max(3, min(height, width))))
            rows, columns = (_stripes(extent, period, random) for extent in (height, width))
            image.masked_fill_(torch.from_numpy(rows[:, None] & columns), 0)


def _stripes(extent: int, period: int, random: np.random.Generator) -> NDArray[np.bool_]:
    """(extent,) bool: true in the first half of each period, with a random phase."""
    return (np.arange(extent) + random.integers(period)) % period < period / 2
