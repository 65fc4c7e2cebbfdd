"""Images with moved grey levels: dark, pale and plain ones."""

import cv2
import numpy as np

from bevcli.inference.image_repair import auto_levels


def scene() -> np.ndarray:
    """(90, 160, 3) a ramp of grey levels with a median of 98."""
    ramp = np.linspace(0, 0.93, 160) ** 1.25 * 255
    return np.broadcast_to(ramp[None, :, None], (90, 160, 3)).round().astype(np.uint8)


def test_dark_and_pale_images_get_the_levels_of_ordinary_ones():
    for image in (scene() * 0.2, scene() * 0.3 + 160, scene() * 0.5 + 20):
        levelled = auto_levels(image.round().astype(np.uint8)).astype(int)
        black, median, white = np.percentile(levelled, (0.5, 50, 99.5))
        assert black <= 35
        assert 70 <= median <= 120
        assert white >= 200
        assert np.all(np.diff(levelled[0, :, 0]) >= 0)


def test_an_ordinary_image_stays_as_it_is():
    assert np.array_equal(auto_levels(scene()), scene())


def test_an_image_without_contrast_stays_as_it_is():
    for level in (0, 128, 255):
        image = np.full((90, 160, 3), level, dtype=np.uint8)
        image[0, 0] = 255 - level  # a single bright pixel
        assert np.array_equal(auto_levels(image), image)


def test_hues_stay():
    image = cv2.merge([scene()[..., 0] // 4, scene()[..., 0] // 2, scene()[..., 0]])
    levelled = auto_levels(image)[:, 1:-1]
    assert np.all(np.diff(levelled.astype(int), axis=2) >= 0)
