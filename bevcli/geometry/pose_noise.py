"""Noise on camera poses, in the levels of BEVFormer's paper."""

from __future__ import annotations

import cv2
import numpy as np

from bevcli.geometry.transforms import Array, rigid

TRANSLATION_M = 0.05  # standard deviation per level and axis


def camera_pose_noise(level: float, random: np.random.Generator) -> Array:
    """(4, 4) camera_from_noisy_camera, metres.

    Level L has normal noise on each axis: rotation with a variance of L degrees², translation with a standard deviation
    of 5 L cm. BEVFormer's paper has the levels 1 to 4.
    """
    rotation_deg = np.sqrt(level) * random.standard_normal(3)
    translation = TRANSLATION_M * level * random.standard_normal(3)
    rotation, _ = cv2.Rodrigues(np.radians(rotation_deg))
    return rigid(translation, rotation)
