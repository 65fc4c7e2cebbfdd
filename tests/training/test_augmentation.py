"""Augmentation and randomisation of images, and noise of the calibration."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from memory_drive import MemoryDrive
from torch import Tensor

from bevcli.model.config import ImageConfig
from bevcli.workshop.training.augmentation import (
    AugmentationConfig,
    BadConditions,
    CalibrationVariation,
    ImageVariation,
    RandomisationConfig,
    distort,
    distorted,
    distorted_images,
    draw_color_change,
    mask_images,
    randomised,
)

NONE = AugmentationConfig(photometric=0, grid_mask=0)


def test_probability_zero_leaves_images_unchanged() -> None:
    frame, random = MemoryDrive(1).load(0), np.random.default_rng(0)
    assert distorted(frame, {}) is frame
    images = torch.ones(1, 2, 3, 8, 8)
    mask_images(images, 0.0, random)
    assert (images == 1).all()
    for variation in (ImageVariation, CalibrationVariation, BadConditions):
        assert variation(NONE, random)(frame) is frame
    assert randomised(images, RandomisationConfig(), LITE, torch.Generator()) is images
    assert AugmentationConfig().randomisation == RandomisationConfig()


def test_distortion_changes_the_image_and_is_reproducible() -> None:
    pixels = np.full((4, 4, 3), (40, 90, 160), dtype=np.uint8)
    changed = distort(pixels, draw_color_change(1.0, np.random.default_rng(1)))
    assert changed.dtype == np.uint8
    assert not np.array_equal(changed, pixels)
    assert np.array_equal(changed, distort(pixels, draw_color_change(1.0, np.random.default_rng(1))))


@pytest.mark.parametrize("color_order", ["rgb", "bgr"])
def test_a_device_distorts_images_as_opencv_does(color_order: str) -> None:
    random = np.random.default_rng(0)
    pixels = random.integers(0, 256, (16, 24, 32, 3), dtype=np.uint8)
    pixels[:, :4] = pixels[:, :4, :, :1]  # grey, which has no hue
    drawn = [draw_color_change(0.5, random) for _ in pixels]
    by_opencv = np.stack([distort(image, one) for image, one in zip(pixels, drawn, strict=True)]).astype(np.float32)
    ordered = [x[..., ::-1] if color_order == "rgb" else x for x in (pixels, by_opencv)]
    images, expected = (torch.from_numpy(x.copy()).movedim(-1, 1) for x in ordered)
    errors = distorted_images(images.float(), torch.tensor(drawn), color_order) - expected
    assert errors.min() > -0.01
    assert errors.max() < 1.01  # the other ones are rounded down
    assert (expected - images).abs().max() > 60


def test_the_grid_mask_covers_about_a_quarter() -> None:
    images = torch.ones(2, 6, 3, 64, 64)
    mask_images(images, 1.0, np.random.default_rng(0))
    covered = (images == 0).float().mean((-1, -2, -3))
    assert ((covered > 0.05) & (covered < 0.6)).all()
    assert covered.mean().item() == pytest.approx(0.25, abs=0.1)


def test_exposure_and_white_balance_last_a_clip_by_camera() -> None:
    sequence, config = MemoryDrive(2), AugmentationConfig(0, 0, exposure=1.0, white_balance=0.2)
    vary = ImageVariation(config, np.random.default_rng(0))
    gains = []
    for frame in (sequence.load(0), sequence.load(1)):
        changed = vary(frame)
        gains.append(
            [
                changed.images[name].pixels_bgr[dark].mean() / image.pixels_bgr[dark].mean()
                for name, image in frame.images.items()
                if (dark := image.pixels_bgr < 100).any()  # brighter pixels may be clipped
            ]
        )
    np.testing.assert_allclose(gains[0], gains[1], rtol=0.02)
    assert np.std(gains[0]) > 0.05


def test_some_images_are_dropped_but_never_all_of_a_frame() -> None:
    frame, random = MemoryDrive(1).load(0), np.random.default_rng(0)
    counts = [len(ImageVariation(AugmentationConfig(drop_image=0.5), random)(frame).images) for _ in range(100)]
    assert 2.5 < np.mean(counts) < 3.5
    assert len(ImageVariation(AugmentationConfig(drop_image=1.0), random)(frame).images) == 1


def test_camera_poses_have_one_noise_in_all_frames_of_a_clip() -> None:
    sequence, config = MemoryDrive(2), AugmentationConfig(calibration_share=1.0, calibration_noise=2.0)
    vary = CalibrationVariation(config, np.random.default_rng(0))
    first, second = vary(sequence.load(0)), vary(sequence.load(1))
    assert first.rig is second.rig
    for camera, noisy in zip(sequence.rig.cameras, first.rig.cameras, strict=True):
        moved = np.linalg.inv(camera.ego_from_camera) @ noisy.ego_from_camera
        assert 0 < np.linalg.norm(moved[:3, 3]) < 0.6
        assert 0 < np.degrees(np.arccos((np.trace(moved[:3, :3]) - 1) / 2)) < 8
        assert np.array_equal(camera.intrinsics, noisy.intrinsics)
    frame, random, quarter = sequence.load(0), np.random.default_rng(0), AugmentationConfig(calibration_share=0.25)
    changed = [CalibrationVariation(quarter, random)(frame) is not frame for _ in range(200)]
    assert np.mean(changed) == pytest.approx(0.25, abs=0.08)


def test_all_images_of_a_clip_have_the_same_corruption() -> None:
    sequence = MemoryDrive(2)
    kinds = set()
    for seed in range(8):
        worsen = BadConditions(AugmentationConfig(corrupted_share=1.0), np.random.default_rng(seed))
        corrupt, level = worsen._corruption
        kinds.add(corrupt)
        for frame in (sequence.load(0), sequence.load(1)):
            worse = worsen(frame)
            for name, image in frame.images.items():
                assert not np.array_equal(worse.images[name].pixels_bgr, image.pixels_bgr), corrupt.__name__
        assert worsen._corruption == (corrupt, level)
    assert len(kinds) >= 3


def test_lost_cameras_stay_lost_and_one_is_left() -> None:
    sequence = MemoryDrive(2)
    counts, black = set(), set()
    for seed in range(40):
        worsen = BadConditions(AugmentationConfig(lost_cameras_share=1.0), np.random.default_rng(seed))
        lost = []
        for frame in (sequence.load(0), sequence.load(1)):
            images = worsen(frame).images
            lost.append({name for name in frame.images if name not in images or not images[name].pixels_bgr.any()})
            assert len(lost[-1]) < len(frame.images)
            black |= {name in images for name in lost[-1]}
        assert lost[0] == lost[1]
        counts.add(len(lost[0]))
    assert len(counts) >= 3
    assert black == {True, False}


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


@pytest.mark.parametrize("change", list(vars(ALL)))
def test_each_change_alters_about_its_share_of_the_images(change: str) -> None:
    pixels = made_images(200)
    difference = (changed(pixels, RandomisationConfig(**{change: 0.3})) - pixels).abs().amax(dim=(1, 2, 3))
    assert 0.2 < (difference > 0.01).float().mean() < 0.4


@pytest.mark.parametrize("change", ["contrast", "blur"])
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
