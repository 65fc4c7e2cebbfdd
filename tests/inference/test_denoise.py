"""Images with strong noise are smoothed, others stay as they are."""

import cv2
import numpy as np
import pytest

from bevcli.inference.image_repair import auto_levels, denoised, measure_noise

RANDOM = np.random.default_rng(0)


def scene() -> np.ndarray:
    """(144, 256, 3) a street of flat colours with sharp edges."""
    image = np.full((144, 256, 3), 150, dtype=np.uint8)
    cv2.rectangle(image, (0, 90), (255, 143), (80, 80, 80), -1)
    cv2.rectangle(image, (60, 50), (120, 100), (30, 60, 220), -1)
    cv2.rectangle(image, (180, 20), (230, 110), (240, 235, 230), -1)
    return image


def noisy(image: np.ndarray, deviation: float) -> np.ndarray:
    return np.clip(image + RANDOM.normal(0, deviation, image.shape), 0, 255).round().astype(np.uint8)


def with_spikes(image: np.ndarray, share: float) -> np.ndarray:
    """Some values are black or white."""
    wrong = RANDOM.random(image.shape) < share
    return np.where(wrong, RANDOM.choice(np.array([0, 255], dtype=np.uint8), image.shape), image)


def unlike(image: np.ndarray, other: np.ndarray) -> float:
    """Mean absolute difference in grey levels."""
    return float(np.abs(image.astype(int) - other).mean())


@pytest.mark.parametrize("deviation", [3, 10, 25])
def test_noise_is_measured(deviation):
    grey = noisy(np.full((200, 300, 1), 128), deviation).repeat(3, axis=2)
    assert measure_noise(grey) == pytest.approx(deviation, rel=0.1)


def test_edges_are_no_noise():
    assert measure_noise(scene()) < 1


def test_images_with_little_noise_stay_as_they_are():
    for image in (scene(), noisy(scene(), 5), np.zeros((2, 2, 3), np.uint8)):
        assert np.array_equal(denoised(image, 1.0, np.asarray), image)


def test_noise_is_smoothed_between_edges():
    image = noisy(scene(), 25)
    smooth = denoised(image, 1.0, np.asarray)
    assert unlike(smooth, scene()) < 0.35 * unlike(image, scene())
    assert abs(int(smooth[75, 121 + 3, 2]) - 150) < 30  # beside the edge of the red box


def test_wrong_pixels_are_removed():
    image = with_spikes(scene(), 0.15)
    assert unlike(denoised(image, 1.0, np.asarray), scene()) < 0.1 * unlike(image, scene())


def test_a_dark_image_gets_ordinary_levels_without_its_noise():
    clean, dark = auto_levels((scene() * 0.15).astype(np.uint8)), noisy(scene() * 0.15, 4)
    assert measure_noise(dark) < 10 < measure_noise(auto_levels(dark))
    assert unlike(denoised(dark, 1.0, auto_levels), clean) < 0.65 * unlike(auto_levels(dark), clean)


def test_noise_that_resizing_averages_is_left_alone():
    large = cv2.resize(scene(), (1024, 576), interpolation=cv2.INTER_NEAREST)
    image = noisy(large, 35)
    assert np.array_equal(denoised(image, 0.25, np.asarray), image)
    assert denoised(image, 0.5, np.asarray).shape == (288, 512, 3)


def test_a_noisy_image_keeps_at_least_one_row():
    image = RANDOM.choice(np.array([0, 255], dtype=np.uint8), (3, 4000, 1)).repeat(3, axis=2)
    assert denoised(image, 0.13, np.asarray).shape == (1, 520, 3)
