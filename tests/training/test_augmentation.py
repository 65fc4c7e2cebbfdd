"""Augmentation of images and of the calibration."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from memory_drive import MemoryDrive

from bevcli.workshop.training.augmentation import (
    AugmentationConfig,
    BadConditions,
    CalibrationVariation,
    ImageVariation,
    distort,
    distorted,
    distorted_images,
    draw_color_change,
    mask_images,
)

NONE = AugmentationConfig(photometric=0, grid_mask=0)


def test_probability_zero_leaves_images_unchanged() -> None:
    frame, random = MemoryDrive(1).load(0), np.random.default_rng(0)
    assert distorted(frame, {}) is frame
    images = torch.ones(1, 2, 3, 8, 8)
    mask_images(images, 0.0, random)
    assert (images == 1).all()


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


def test_images_and_calibration_stay_unless_the_config_says_so() -> None:
    frame, random = MemoryDrive(1).load(0), np.random.default_rng(0)
    assert ImageVariation(NONE, random)(frame) is frame
    assert CalibrationVariation(NONE, random)(frame) is frame
    assert BadConditions(NONE, random)(frame) is frame


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


def test_a_share_of_the_clips_has_calibration_noise() -> None:
    frame, random = MemoryDrive(1).load(0), np.random.default_rng(0)
    config = AugmentationConfig(calibration_share=0.25)
    noisy = [CalibrationVariation(config, random)(frame) is not frame for _ in range(200)]
    assert np.mean(noisy) == pytest.approx(0.25, abs=0.08)


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
