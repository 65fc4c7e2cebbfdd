"""Images with strong noise, with fog or with moved grey levels are repaired; others stay as they are."""

import cv2
import numpy as np
import pytest

from bevcli.inference.image_repair import auto_levels, defogged, denoised, measure_noise
from bevcli.workshop.synth import corruptions

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
        assert np.array_equal(denoised(image, 1.0), image)


def test_noise_is_smoothed_between_edges():
    image = noisy(scene(), 25)
    smooth = denoised(image, 1.0)
    assert unlike(smooth, scene()) < 0.35 * unlike(image, scene())
    assert abs(int(smooth[75, 121 + 3, 2]) - 150) < 30  # beside the edge of the red box


def test_wrong_pixels_are_removed():
    image = with_spikes(scene(), 0.15)
    assert unlike(denoised(image, 1.0), scene()) < 0.1 * unlike(image, scene())


def test_a_dark_image_gets_ordinary_levels_without_its_noise():
    clean, dark = auto_levels((scene() * 0.15).astype(np.uint8)), noisy(scene() * 0.15, 4)
    assert measure_noise(dark) < 10 < measure_noise(auto_levels(dark))
    assert unlike(denoised(dark, 1.0, auto=True), clean) < 0.65 * unlike(auto_levels(dark), clean)


def test_noise_that_resizing_averages_is_left_alone():
    large = cv2.resize(scene(), (1024, 576), interpolation=cv2.INTER_NEAREST)
    image = noisy(large, 35)
    assert np.array_equal(denoised(image, 0.25), image)
    assert denoised(image, 0.5).shape == (288, 512, 3)


def test_a_noisy_image_keeps_at_least_one_row():
    image = RANDOM.choice(np.array([0, 255], dtype=np.uint8), (3, 4000, 1)).repeat(3, axis=2)
    assert denoised(image, 0.13).shape == (1, 520, 3)


LEVELS = (2, 4, 5)


def colored_boxes(width: int = 512) -> np.ndarray:
    """(H, W, 3) boxes of many colours, dark ones too, on a grey street."""
    random = np.random.default_rng(3)
    image = np.full((288, 512, 3), 110, dtype=np.uint8)
    for _ in range(150):
        corner, size = random.integers(0, (512, 288)), random.integers(10, 60, 2)
        color = [int(value) for value in random.integers(5, 230, 3)]
        cv2.rectangle(image, corner.tolist(), (corner + size).tolist(), color, -1)
    return cv2.resize(image, (width, width * 288 // 512), interpolation=cv2.INTER_LINEAR)


@pytest.mark.parametrize("width", [512, 1600])
@pytest.mark.parametrize("level", LEVELS)
def test_fog_is_taken_away(level, width):
    clean = colored_boxes(width)
    foggy = corruptions.fog(clean, level, np.random.default_rng(level))
    found = auto_levels(defogged(foggy))
    assert unlike(found, auto_levels(clean)) < 0.8 * unlike(auto_levels(foggy), auto_levels(clean))


@pytest.mark.parametrize("other", ["brightness", "low_contrast", "motion_blur", "defocus_blur", "impulse_noise"])
def test_other_images_stay_as_they_are(other):
    for level in LEVELS:
        image = getattr(corruptions, other)(colored_boxes(), level, np.random.default_rng(0))
        assert defogged(image) is image


@pytest.mark.parametrize("grey", [0, 90, 255])
def test_small_and_plain_images_stay_as_they_are(grey):
    for size in ((1, 1), (2, 40), (16, 16), (300, 5), (90, 160)):
        image = np.full((*size, 3), grey, dtype=np.uint8)
        assert np.array_equal(defogged(image), image)
    image[0, 0] = 255 - grey  # a single pixel of another brightness
    assert np.array_equal(auto_levels(image), image)


def ramp() -> np.ndarray:
    """(90, 160, 3) a ramp of grey levels with a median of 98."""
    ramp = np.linspace(0, 0.93, 160) ** 1.25 * 255
    return np.broadcast_to(ramp[None, :, None], (90, 160, 3)).round().astype(np.uint8)


def test_dark_and_pale_images_get_the_levels_of_ordinary_ones():
    for image in (ramp() * 0.2, ramp() * 0.3 + 160, ramp() * 0.5 + 20):
        levelled = auto_levels(image.round().astype(np.uint8)).astype(int)
        black, median, white = np.percentile(levelled, (0.5, 50, 99.5))
        assert black <= 35
        assert 70 <= median <= 120
        assert white >= 200
        assert np.all(np.diff(levelled[0, :, 0]) >= 0)


def test_an_ordinary_image_stays_as_it_is():
    assert np.array_equal(auto_levels(ramp()), ramp())


def test_hues_stay():
    image = cv2.merge([ramp()[..., 0] // 4, ramp()[..., 0] // 2, ramp()[..., 0]])
    levelled = auto_levels(image)[:, 1:-1]
    assert np.all(np.diff(levelled.astype(int), axis=2) >= 0)
