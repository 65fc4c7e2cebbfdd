"""Brightness and low light, with the parameters of RoboBEV."""

from __future__ import annotations

import cv2
import numpy as np

from bevcli.robustness.processing import Level, Pixels, to_uint8

# Level -> what is added to the value of HSV, which is in 0 to 1.
BRIGHTNESS = {1: 0.1, 2: 0.2, 3: 0.3, 4: 0.4, 5: 0.5}
LOW_LIGHT_GAMMA = 2.0
# Level -> brightest value, photons per unit of brightness, standard deviation of the read noise. The public code of
# RoboBEV counts these entries from 0: its severity 2 takes the third one, as here.
LOW_LIGHT = {0: (0.6, 600, 0.008), 1: (0.5, 250, 0.012), 2: (0.4, 120, 0.018), 3: (0.3, 50, 0.026), 4: (0.2, 30, 0.038)}


def brightness(pixels_bgr: Pixels, level: Level, random: np.random.Generator) -> Pixels:
    """A brighter image: the value of HSV is raised and clipped; hue and saturation stay.

    pixels_bgr: (H, W, 3). level: of BRIGHTNESS. random: not used.
    """
    hsv = cv2.cvtColor(pixels_bgr.astype(np.float32) / 255, cv2.COLOR_BGR2HSV)
    hsv[..., 2] = np.clip(hsv[..., 2] + BRIGHTNESS[level], 0, 1)
    return to_uint8(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR))


def low_light(pixels_bgr: Pixels, level: Level, random: np.random.Generator) -> Pixels:
    """A dark, noisy image: stretched to 0 to 1, gamma 2, dimmed, with photon noise (Poisson) and read noise (Gaussian).

    pixels_bgr: (H, W, 3). level: of LOW_LIGHT.
    """
    brightest, photons, read_noise = LOW_LIGHT[level]
    values = pixels_bgr.astype(np.float32) / 255
    low, high = float(values.min()), float(values.max())
    stretched = (values - low) / max(high - low, 1e-6)
    dim = brightest * stretched**LOW_LIGHT_GAMMA
    noisy = np.clip(random.poisson(dim * photons) / photons, 0, 1)
    return to_uint8(noisy + read_noise * random.standard_normal(noisy.shape, dtype=np.float32))
