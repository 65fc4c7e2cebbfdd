"""Fog is recognised, and its light taken away; other images stay as they are."""

import cv2
import numpy as np
import pytest

from bevcli.inference.image_repair import auto_levels, defogged
from bevcli.workshop.synth import corruptions

LEVELS = (2, 4, 5)


def scene(width: int = 512) -> np.ndarray:
    """(H, W, 3) boxes of many colours, dark ones too, on a grey street."""
    random = np.random.default_rng(3)
    image = np.full((288, 512, 3), 110, dtype=np.uint8)
    for _ in range(150):
        corner, size = random.integers(0, (512, 288)), random.integers(10, 60, 2)
        color = [int(value) for value in random.integers(5, 230, 3)]
        cv2.rectangle(image, corner.tolist(), (corner + size).tolist(), color, -1)
    return cv2.resize(image, (width, width * 288 // 512), interpolation=cv2.INTER_LINEAR)


def unlike(image: np.ndarray, other: np.ndarray) -> float:
    """Mean absolute difference in grey levels."""
    return float(np.abs(image.astype(int) - other).mean())


@pytest.mark.parametrize("width", [512, 1600])
@pytest.mark.parametrize("level", LEVELS)
def test_fog_is_taken_away(level, width):
    clean = scene(width)
    foggy = corruptions.fog(clean, level, np.random.default_rng(level))
    found = auto_levels(defogged(foggy))
    assert unlike(found, auto_levels(clean)) < 0.8 * unlike(auto_levels(foggy), auto_levels(clean))


@pytest.mark.parametrize("other", ["brightness", "low_contrast", "motion_blur", "defocus_blur", "impulse_noise"])
def test_other_images_stay_as_they_are(other):
    for level in LEVELS:
        image = getattr(corruptions, other)(scene(), level, np.random.default_rng(0))
        assert defogged(image) is image


@pytest.mark.parametrize("size", [(1, 1), (2, 40), (16, 16), (300, 5)])
@pytest.mark.parametrize("grey", [0, 90, 255])
def test_small_and_plain_images_stay_as_they_are(size, grey):
    image = np.full((*size, 3), grey, dtype=np.uint8)
    assert np.array_equal(defogged(image), image)
