"""Texture and features of a part of an image."""

import numpy as np
import pytest

from bevcli.workshop.correspondence.images import GreyImage, features, texture

PIXELS = np.random.default_rng(0).integers(0, 256, (30, 40)).repeat(6, axis=0).repeat(6, axis=1).astype(np.uint8)
LEFT = np.arange(240) < 120


@pytest.mark.parametrize("brightness", [0, 90])
def test_texture_is_that_of_what_is_seen(brightness):
    """And not of the brightness beside it, which is what an image has where no camera looks."""
    seen = np.broadcast_to(LEFT, PIXELS.shape)
    found = texture(np.where(seen, PIXELS, brightness).astype(np.uint8), seen)
    assert (found[:, 120:] == 128).all()
    assert np.abs(found[:, :98].astype(int) - texture(PIXELS)[:, :98]).max() <= 1  # the rest is near the edge


def test_texture_does_not_depend_on_light():
    assert np.abs(texture(PIXELS // 2 + 60).astype(int) - texture(PIXELS)).max() < 8


def test_features_are_those_of_what_is_seen():
    image = GreyImage(PIXELS, texture(PIXELS))
    found = features(image, np.broadcast_to(LEFT, PIXELS.shape))
    everywhere = features(image)
    assert 50 < len(found.pixels) < len(everywhere.pixels)
    assert found.pixels[:, 0].max() < 121
