"""Images with stretched grey levels: dark, pale and plain ones."""

import cv2
import numpy as np

from bevcli.inference.auto_levels import auto_levels


def scene() -> np.ndarray:
    """(90, 160, 3) a ramp of grey levels with a median of about 0.45."""
    ramp = np.linspace(0, 255, 160) * 0.9
    return np.broadcast_to(ramp[None, :, None], (90, 160, 3)).round().astype(np.uint8)


def test_a_dark_and_a_pale_image_become_the_same():
    dark, pale = (scene() * 0.2).round().astype(np.uint8), (scene() * 0.3 + 160).round().astype(np.uint8)
    first, second = auto_levels(dark).astype(int), auto_levels(pale).astype(int)
    assert np.abs(first - second).max() <= 8  # steps of the dark image, which has 46 levels
    assert first.min() == 0
    assert first.max() == 255
    assert abs(np.median(first) - 0.45 * 255) < 6


def test_an_image_without_contrast_stays_as_it_is():
    for level in (0, 128, 255):
        image = np.full((90, 160, 3), level, dtype=np.uint8)
        image[0, 0] = 255 - level  # a single bright pixel
        assert np.array_equal(auto_levels(image), image)


def test_hues_stay():
    image = cv2.merge([scene()[..., 0] // 4, scene()[..., 0] // 2, scene()[..., 0]])
    levelled = auto_levels(image)[:, 1:-1]
    assert np.all(np.diff(levelled.astype(int), axis=2) >= 0)
