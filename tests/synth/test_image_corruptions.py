"""Each corruption of images against numbers worked out by hand, or against another library."""

import colorsys

import numpy as np
import pytest
from PIL import Image, ImageOps

from bevcli.workshop.robustness.conditions import Draws
from bevcli.workshop.synth.corruptions import (
    FOG,
    LOW_LIGHT,
    blur_kernel,
    brightness,
    color_quantisation,
    defocus_blur,
    fog,
    fractal,
    impulse_noise,
    jpeg,
    low_contrast,
    low_light,
    motion_blur,
    saturation,
    snow,
)

OF_FIVE = (brightness, motion_blur, fog, defocus_blur, low_contrast, impulse_noise, jpeg, saturation)
LEVELS = {**dict.fromkeys(OF_FIVE, 5), low_light: 4, color_quantisation: 3, snow: 3}


def noise_image(height: int = 90, width: int = 160) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (height, width, 3), dtype=np.uint8)


def random(*keys: str | int, seed: int = 0) -> np.random.Generator:
    return Draws(seed, "test").generator(*keys)


@pytest.mark.parametrize("corrupt", LEVELS, ids=lambda corrupt: corrupt.__name__)
def test_a_corruption_keeps_shape_and_type_and_repeats_exactly(corrupt):
    image = noise_image()
    before = image.copy()
    first, second = (corrupt(image, LEVELS[corrupt], random("a", 3, "CAM_FRONT")) for _ in range(2))
    assert first.shape == image.shape
    assert first.dtype == np.uint8
    assert first.tobytes() == second.tobytes()
    assert not np.array_equal(first, image)
    assert np.array_equal(image, before)


@pytest.mark.parametrize("corrupt", [low_light, motion_blur, fog, snow], ids=lambda corrupt: corrupt.__name__)
def test_random_corruptions_differ_by_camera_frame_and_seed(corrupt):
    image = noise_image()
    keys = [random("a", 3, "CAM_FRONT"), random("a", 3, "CAM_BACK"), random("a", 4, "CAM_FRONT")]
    keys.append(random("a", 3, "CAM_FRONT", seed=1))
    assert len({corrupt(image, LEVELS[corrupt], key).tobytes() for key in keys}) == 4


@pytest.mark.parametrize(("level", "bits"), [(1, 4), (2, 3), (3, 2)])
def test_color_quantisation_is_the_posterisation_of_pillow(level, bits):
    image = noise_image()
    posterised = np.asarray(ImageOps.posterize(Image.fromarray(image), bits))
    assert np.array_equal(color_quantisation(image, level, random()), posterised)


def test_brightness_raises_value_and_keeps_hue_and_saturation():
    image = noise_image(4, 5)
    brighter = brightness(image, 2, random())
    for before, after in zip(image.reshape(-1, 3), brighter.reshape(-1, 3), strict=True):
        hue, saturation, value = colorsys.rgb_to_hsv(*(before[::-1] / 255))
        expected = np.array(colorsys.hsv_to_rgb(hue, saturation, min(value + 0.2, 1)))[::-1] * 255
        assert np.abs(after - expected).max() <= 1


def test_low_light_dims_and_adds_noise_of_the_stated_variance():
    image = np.zeros((200, 300, 3), dtype=np.uint8)
    image[:100] = 51  # the darkest and the brightest value are 51 and 204, so 127.5 would be half of the range
    image[:100, :150] = 204
    image[100:] = 102  # a third of the range
    brightest, photons, read_noise = LOW_LIGHT[3]
    dark = low_light(image, 3, random()) / 255
    assert dark[:100, :150].mean() == pytest.approx(brightest, abs=0.003)
    third = dark[100:]
    assert third.mean() == pytest.approx(brightest / 9, abs=0.005)  # clipping at 0 raises the mean a little
    assert dark[:100, :150].var() == pytest.approx(brightest / photons + read_noise**2, rel=0.05)


def test_motion_blur_spreads_a_point_and_leaves_even_areas():
    image = np.zeros((181, 1600, 3), dtype=np.uint8)
    image[90, 800] = 255
    rows, columns = np.nonzero(motion_blur(image, 2, random())[..., 0])
    assert len(columns) > 5
    # Within 45° of the horizontal, up to the rounding to pixels.
    assert abs(rows[-1] - rows[0]) <= abs(columns.max() - columns.min()) + 2
    assert (motion_blur(np.full_like(image, 77), 5, random()) == 77).all()


def test_a_blur_has_the_same_relative_length_at_every_width():
    def length(scale: float) -> float:
        kernel = blur_kernel(15, 12.0, 30.0, scale)
        y, x = np.indices(kernel.shape) - (len(kernel) - 1) / 2
        return float(np.hypot((kernel * x).sum(), (kernel * y).sum()))  # the centroid moves with the line

    steps = np.arange(31)
    weights = np.exp(-(steps**2) / (2 * 12.0**2))
    by_hand = (steps * weights).sum() / weights.sum()
    assert length(1.0) == pytest.approx(by_hand, rel=1e-5)
    assert length(0.32) == pytest.approx(0.32 * by_hand, rel=1e-5)


def test_fog_reduces_contrast_by_the_stated_factor():
    dark, bright = np.full((60, 80, 3), 40, dtype=np.uint8), np.full((60, 80, 3), 40, dtype=np.uint8)
    bright[30] = 90
    dark[0, 0] = bright[0, 0] = 255  # both images have the same brightest value
    difference = fog(bright, 4, random())[30].astype(float) - fog(dark, 4, random())[30]
    assert difference == pytest.approx(50 / (1 + FOG[4][0]), abs=1.01)


def test_the_fog_covers_0_to_1_and_is_finer_with_a_smaller_decay():
    coarse, fine = (fractal(128, decay, random()) for decay in (2.0, 1.4))
    for grid in (coarse, fine):
        assert grid.shape == (128, 128)
        assert (grid.min(), grid.max()) == (0, 1)
        # Neighbours are much more alike than distant cells, also across the edge: the map is periodic.
        assert np.abs(grid - np.roll(grid, 1, axis=1)).mean() < 0.3 * np.abs(grid - np.roll(grid, 64, axis=1)).mean()
    assert np.abs(np.diff(fine)).mean() > 2 * np.abs(np.diff(coarse)).mean()


def test_snow_whitens_the_image_and_adds_grey_flakes():
    snowy = snow(np.zeros((288, 512, 3), dtype=np.uint8), 1, random())
    assert snowy.min() == pytest.approx(0.2 * 0.5 * 255, abs=1)  # between flakes: (1 - 0.8) of 1.5 grey + 0.5
    assert 0.02 < (snowy > 60).mean() < 0.6
    assert (snowy[..., 0] == snowy[..., 1]).all()


def test_as_much_snow_falls_in_small_images_as_in_large_ones():
    small, large = (snow(np.zeros((h, w, 3), np.uint8), 2, random()).mean() for h, w in ((288, 512), (900, 1600)))
    assert small == pytest.approx(large, rel=0.03)


def test_contrast_impulse_noise_and_saturation_by_hand():
    image = np.stack([np.full((8, 8), 40), np.full((8, 8), 120)], axis=1).reshape(8, 16, 1).repeat(3, 2)
    assert set(np.unique(low_contrast(image.astype(np.uint8), 4, random()))) == {76, 84}  # 80 -/+ 0.1 * 40
    noisy = impulse_noise(np.full((200, 200, 3), 100, dtype=np.uint8), 5, random())
    assert np.mean(noisy == 0) == pytest.approx(0.135, abs=0.005)
    assert np.mean(noisy == 255) == pytest.approx(0.135, abs=0.005)
    image = np.full((4, 4, 3), (50, 100, 200), dtype=np.uint8)
    assert np.ptp(saturation(image, 2, random())[0, 0]) == pytest.approx(15, abs=1)  # a tenth of 150
    assert saturation(image, 5, random())[0, 0].min() == 0


def test_defocus_spreads_a_point_over_a_disk():
    image = np.zeros((201, 1600, 3), dtype=np.uint8)
    image[100, 800] = 255
    blurred = defocus_blur(image, 2, random())[..., 0] > 0  # radius 4
    assert np.array_equal(np.argwhere(blurred.any(axis=0)).ravel(), np.arange(796, 805))
    assert 45 <= blurred.sum() <= 61  # pi * 4² is 50
