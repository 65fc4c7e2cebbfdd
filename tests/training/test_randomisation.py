"""Randomisation of training images: one draw an image, the same for every normalisation."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bevcli.model.config import ImageConfig
from bevcli.workshop.training.augmentation import AugmentationConfig, RandomisationConfig, randomised

LITE = ImageConfig((48, 32), (127.0,) * 3, (128.0,) * 3, "rgb")
IMAGENET = ImageConfig((48, 32), (123.675, 116.28, 103.53), (58.395, 57.12, 57.375), "rgb")
ALL = RandomisationConfig(0.5, 0.6, 0.6, 0.5, 0.2, 0.3)


def made_images(count: int = 12) -> Tensor:
    """(count, 3, 32, 48) smooth images with some noise, pixel values of 0 to 255."""
    random = torch.Generator().manual_seed(1)
    coarse = torch.rand(count, 3, 4, 6, generator=random) * 200
    smooth = torch.nn.functional.interpolate(coarse, size=(32, 48), mode="bilinear")
    return smooth + 40 * torch.rand(count, 3, 32, 48, generator=random)


def normalised(pixels: Tensor, image: ImageConfig) -> Tensor:
    mean, std = (torch.tensor(values)[:, None, None] for values in (image.mean, image.std))
    return (pixels - mean) / std


def pixels_of(images: Tensor, image: ImageConfig) -> Tensor:
    mean, std = (torch.tensor(values)[:, None, None] for values in (image.mean, image.std))
    return images * std + mean


def changed(pixels: Tensor, config: RandomisationConfig, image: ImageConfig = LITE, seed: int = 0) -> Tensor:
    """Pixel values after the changes."""
    given = normalised(pixels, image)
    return pixels_of(randomised(given, config, image, torch.Generator().manual_seed(seed)), image)


def test_a_seed_gives_the_same_images_and_another_seed_others() -> None:
    pixels = made_images()
    assert torch.equal(changed(pixels, ALL), changed(pixels, ALL))
    assert not torch.equal(changed(pixels, ALL), changed(pixels, ALL, seed=1))


def test_without_probabilities_images_are_the_same_tensor() -> None:
    images = made_images()
    assert randomised(images, RandomisationConfig(), LITE, torch.Generator()) is images
    assert AugmentationConfig().randomisation == RandomisationConfig()


@pytest.mark.parametrize("change", list(vars(ALL)))
def test_each_change_alters_about_its_share_of_the_images(change: str) -> None:
    pixels = made_images(200)
    difference = (changed(pixels, RandomisationConfig(**{change: 0.3})) - pixels).abs().amax(dim=(1, 2, 3))
    assert 0.2 < (difference > 0.01).float().mean() < 0.4


@pytest.mark.parametrize("change", ["contrast", "color", "saturation", "blur", "noise"])
def test_models_of_any_normalisation_see_the_same_changes(change: str) -> None:
    pixels, config = made_images(), RandomisationConfig(**{change: 1.0})
    torch.testing.assert_close(changed(pixels, config, IMAGENET), changed(pixels, config), atol=0.01, rtol=1e-4)


def test_convolutions_keep_contrast_and_differ_between_images() -> None:
    pixels = made_images(1).expand(64, -1, -1, -1)
    found = normalised(changed(pixels, RandomisationConfig(convolution=1.0)), LITE)
    deviations = found.std(dim=(1, 2, 3)) / normalised(pixels[0], LITE).std()
    assert 0.4 < deviations.min() < deviations.max() < 1.6
    flat = found.flatten(1)
    assert torch.cdist(flat, flat).add(torch.eye(64)).min() > 0.1


def test_a_convolution_mixes_pixels_up_to_three_away() -> None:
    images = torch.full((64, 3, 32, 48), 1e-3)
    images[:, :, 16, 24] = 1.0
    config = RandomisationConfig(convolution=1.0)
    found = randomised(images, config, LITE, torch.Generator().manual_seed(0))
    # The constant part of each image is the same far from its borders and from the point.
    spread = (found - found[:, :, 8:9, 12:13]).abs()[:, :, 8:25, 12:37].amax(dim=1) > 0.02  # (64, 17, 25)
    widths = {int(each.any(0).sum()) for each in spread}
    assert widths == {1, 3, 5, 7}


def test_no_saturation_leaves_the_mean_of_the_channels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bevcli.workshop.training.augmentation.SATURATION_RANGE", (0.0, 0.0))
    pixels = made_images()
    found = changed(pixels, RandomisationConfig(saturation=1.0), IMAGENET)
    torch.testing.assert_close(found, pixels.mean(1, keepdim=True).expand_as(pixels), atol=0.01, rtol=1e-4)


def test_contrast_and_brightness_are_those_of_the_ranges(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bevcli.workshop.training.augmentation.CONTRAST_RANGE", (1.5, 1.5))
    monkeypatch.setattr("bevcli.workshop.training.augmentation.BRIGHTNESS_RANGE", (10.0, 10.0))
    pixels = made_images()
    found = changed(pixels, RandomisationConfig(contrast=1.0), IMAGENET)
    torch.testing.assert_close(found, 1.5 * (pixels - 127) + 10 + 127, atol=0.01, rtol=1e-4)


def test_padding_and_missing_images_stay_zero() -> None:
    images = normalised(made_images(), LITE).unflatten(0, (2, 6))  # (2, 6, 3, 32, 48)
    images[0, 2] = 0
    images[..., 24:, :] = 0
    images[..., 40:] = 0
    config = replace(ALL, **dict.fromkeys(vars(ALL), 1.0))
    found = randomised(images, config, LITE, torch.Generator().manual_seed(0))
    assert not found[0, 2].any()
    assert not found[..., 24:, :].any()
    assert not found[..., 40:].any()
    assert (found[1, 2, :, :24, :40] != images[1, 2, :, :24, :40]).all()


def test_a_probability_above_one_is_refused() -> None:
    with pytest.raises(ValueError, match="color is a probability"):
        RandomisationConfig(color=1.5)
