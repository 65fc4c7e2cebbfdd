"""Photometric distortion and grid mask: images change in training, the world in them does not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bevcli.frame import CameraImage, Frame

BRIGHTNESS = 32.0  # added, at most
CONTRAST = SATURATION = (0.5, 1.5)  # multiplied
HUE_DEG = 18.0


@dataclass(frozen=True)
class AugmentationConfig:
    """photometric: the chance of each distortion (brightness, contrast, saturation, hue) of an image.

    grid_mask: the chance that a grid of grey squares covers an image.
    """

    photometric: float = 0.5
    grid_mask: float = 0.7

    def __post_init__(self) -> None:
        if not (0 <= self.photometric <= 1 and 0 <= self.grid_mask <= 1):
            raise ValueError("photometric and grid_mask are chances, from 0 to 1")


def distort_images(frame: Frame, chance: float, random: np.random.Generator) -> Frame:
    """The frame with each image's light and colours changed."""
    if chance == 0:
        return frame
    images: Mapping[str, CameraImage] = {
        name: replace(image, pixels_bgr=distort(image.pixels_bgr, chance, random))
        for name, image in frame.images.items()
    }
    return replace(frame, images=images)


def distort(pixels_bgr: NDArray[np.uint8], chance: float, random: np.random.Generator) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 with another brightness, contrast, saturation and hue, each by chance."""
    applied = random.random(4) < chance
    brightness = random.uniform(-BRIGHTNESS, BRIGHTNESS) * applied[0]
    contrast, saturation = random.uniform(*CONTRAST), random.uniform(*SATURATION)
    hue_deg = random.uniform(-HUE_DEG, HUE_DEG) * applied[3]
    pixels = (pixels_bgr.astype(np.float32) + np.float32(brightness)) * np.float32(contrast if applied[1] else 1)
    if applied[2] or applied[3]:
        hsv = cv2.cvtColor(pixels.clip(0, 255) / np.float32(255), cv2.COLOR_BGR2HSV)
        hsv[..., 0] = (hsv[..., 0] + hue_deg) % 360
        hsv[..., 1] = (hsv[..., 1] * (saturation if applied[2] else 1)).clip(0, 1)
        pixels = cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR) * np.float32(255)
    return pixels.clip(0, 255).astype(np.uint8)


def mask_images(images: Tensor, chance: float, random: np.random.Generator) -> None:
    """Greys a grid of squares in each of the normalised images (..., 3, H, W), in place."""
    for image in images.flatten(0, -4):
        if random.random() < chance:
            height, width = image.shape[-2:]
            period = int(random.integers(2, max(3, min(height, width))))
            rows, columns = (_stripes(extent, period, random) for extent in (height, width))
            image.masked_fill_(torch.from_numpy(rows[:, None] & columns), 0)


def _stripes(extent: int, period: int, random: np.random.Generator) -> NDArray[np.bool_]:
    """(extent,) bool: the first half of each period, from a random start."""
    return (np.arange(extent) + random.integers(period)) % period < period / 2
