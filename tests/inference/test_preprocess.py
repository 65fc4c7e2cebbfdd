"""Images and projections of a frame for the network; repair of images with noise, fog or moved grey levels."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from memory_drive import MemoryDrive, WithoutImages, make_camera, make_rig

from bevcli.errors import InputError
from bevcli.geometry.cameras import NUSCENES_YAWS_DEG, CameraRig, Distortion
from bevcli.geometry.transforms import Pose, apply, inverse
from bevcli.inference.image_repair import auto_levels, defogged, denoised, measure_noise
from bevcli.inference.preprocess import Preprocessor, image_for_rig, pixel_weights, resize_and_normalize
from bevcli.model.step import assign_cameras, model_inputs
from bevcli.workshop.synth import corruptions
from bevcli.workshop.training.samples import joined_inputs


def textbook_image(pixels, image):
    """The original's order: normalise as float, resize, pad right and bottom."""
    rgb = pixels[..., ::-1] if image.color_order == "rgb" else pixels
    normalised = (rgb.astype(np.float32) - np.float32(image.mean)) / np.float32(image.std)
    resized = cv2.resize(normalised, image.size, interpolation=cv2.INTER_LINEAR)
    width, height = image.padded_size
    padded = np.zeros((height, width, 3), np.float32)
    padded[: resized.shape[0], : resized.shape[1]] = resized
    return padded.transpose(2, 0, 1)


@pytest.mark.parametrize("order", ["rgb", "bgr"])
def test_images_equal_normalising_before_resizing(mini_config, order):
    config = replace(mini_config, image=replace(mini_config.image, color_order=order))
    frame = MemoryDrive().load(1)
    images = Preprocessor(config)(frame).images[0].numpy()
    expected = [textbook_image(frame.images[name].pixels_bgr, config.image) for name in config.cameras]
    np.testing.assert_allclose(images, np.stack(expected), rtol=0, atol=1e-5)


def test_projection_uses_the_pose_at_each_cameras_time(mini_config):
    frame = MemoryDrive().load(1)
    late = Pose(frame.world_from_ego.translation + [1.5, 0, 0], frame.world_from_ego.quaternion)
    frame = replace(frame, world_from_ego_at={**frame.world_from_ego_at, "CAM_FRONT": late})
    point_bev = np.array([2.0, 15.0, -1.0])
    point_world = apply(frame.world_from_ego.matrix @ frame.rig.ego_from_bev, point_bev)
    expected, depth = frame.rig["CAM_FRONT"].project_ego(apply(inverse(late.matrix), point_world))
    u, v, d, one = Preprocessor(mini_config)(frame).image_from_bev[0, 0].numpy() @ [*point_bev, 1]
    assert (u / d, v / d) == pytest.approx(expected * 0.5, abs=1e-3)  # 320 pixels become 160
    assert (d, one) == pytest.approx((float(depth), 1.0), abs=1e-4)


def test_an_image_of_another_aspect_ratio_is_fitted_as_its_rig(mini_config):
    camera = make_camera("CAM_FRONT", 0, width=300, height=300)
    sequence = MemoryDrive(rig=CameraRig((camera,), make_rig().ego_from_bev))
    prepared = Preprocessor(mini_config)(sequence.load(0))
    assert prepared.images.shape == (1, 1, 3, 96, 160)
    assert prepared.scales == (pytest.approx(0.3),)
    assert (prepared.images[0, 0, :, :, 90:] == 0).all()
    assert (prepared.images[0, 0, :, 90:] == 0).all()
    assert (prepared.images[0, 0, :, :90, :90] != 0).any()
    expected, _ = camera.project_ego([12.0, 1.0, 0.5])
    point_bev = apply(inverse(sequence.rig.ego_from_bev), [12.0, 1.0, 0.5])
    u, v, d, _ = prepared.image_from_bev[0, 0].numpy() @ [*point_bev, 1]
    assert (u / d, v / d) == pytest.approx(0.3 * expected, abs=1e-3)


def test_images_are_undistorted_before_resizing(mini_config):
    lens = Distortion("kannala_brandt", (0.05, -0.01, 0.0, 0.0))
    plain = make_camera("CAM_FRONT", 0)
    bent = replace(plain, distortion=lens)
    point_ego = np.array([12.0, 5.0, 3.5])
    drawn = np.zeros((180, 320, 3), np.uint8)
    seen, _ = bent.project_ego(point_ego)
    cv2.circle(drawn, np.round(seen * 16).astype(int).tolist(), 5 * 16, (255, 255, 255), -1, shift=4)
    sequence = MemoryDrive(rig=CameraRig((bent,), make_rig().ego_from_bev))
    frame = sequence.load(0)
    frame = replace(frame, images={"CAM_FRONT": replace(frame.images["CAM_FRONT"], pixels_bgr=drawn)})
    bright = Preprocessor(mini_config)(frame).images[0, 0, 0].numpy() > 0
    ys, xs = np.nonzero(bright)
    expected, _ = plain.project_ego(point_ego)
    assert (xs.mean(), ys.mean()) == pytest.approx(expected / 2, abs=0.6)
    assert np.linalg.norm(seen - expected) > 2


def test_missing_image_is_black_and_marked(mini_config):
    prepared = Preprocessor(mini_config)(WithoutImages({0: ["CAM_BACK"]}).load(0))
    place = prepared.assignment.cameras.index("CAM_BACK")
    assert prepared.has_image[0].tolist() == [name != "CAM_BACK" for name in prepared.assignment.cameras]
    assert (prepared.images[0, place] == 0).all()


def test_projections_follow_the_resized_image_within_a_pixel(mini_config):
    """A bright spot, resized to a quarter, lies where its ray is projected to."""
    config = replace(mini_config, image=replace(mini_config.image, resize="area", half_pixel_shift=True))
    camera = make_camera("CAM_FRONT", 0, width=640, height=384)
    sequence = MemoryDrive(rig=CameraRig((camera,), make_rig().ego_from_bev))
    frame = sequence.load(0)
    dark = np.zeros((384, 640, 3), np.uint8)
    dark[100:107, 300:307] = 255  # its centre is pixel (303, 103)
    frame = replace(frame, images={"CAM_FRONT": replace(frame.images["CAM_FRONT"], pixels_bgr=dark)})
    prepared = Preprocessor(config)(frame)
    image = prepared.images[0, 0, 0, :90, :150].numpy()  # without the padding
    weights = image - image.min()
    rows, columns = np.indices(weights.shape)
    seen = (columns * weights).sum() / weights.sum(), (rows * weights).sum() / weights.sum()
    in_camera = 10.0 * np.linalg.inv(camera.intrinsics) @ [303, 103, 1]
    point_bev = apply(inverse(sequence.rig.ego_from_bev) @ camera.ego_from_camera, in_camera)
    u, v, d, _ = prepared.image_from_bev[0, 0].numpy() @ [*point_bev, 1]
    assert seen == pytest.approx((u / d, v / d), abs=0.1)


def wide_rig(half_width_over_focal: float, count: int = 3) -> CameraRig:
    cameras = tuple(make_camera(f"CAM_{index}", 90.0 * index) for index in range(count))
    focal = 160 / half_width_over_focal
    lens = np.array([[focal, 0, 160], [0, focal, 90], [0, 0, 1]])
    return CameraRig(tuple(replace(camera, intrinsics=lens) for camera in cameras), make_rig().ego_from_bev)


def test_images_of_wide_cameras_are_enlarged_to_the_focal_length(mini_config):
    config = replace(mini_config, image=replace(mini_config.image, focal_px=120.0, max_pixels=10**6))
    sequence = MemoryDrive(rig=wide_rig(2.0))  # 80 pixels of focal length, 40 in images of the model's size
    prepared = Preprocessor(config)(sequence.load(0))
    assert prepared.scales == pytest.approx((1.5, 1.5, 1.5))
    assert prepared.images.shape == (1, 3, 3, 288, 480)
    camera = prepared.frame.rig["CAM_0"]
    expected, _ = camera.project_ego([12.0, 1.0, 0.5])
    point_bev = apply(inverse(prepared.frame.rig.ego_from_bev), [12.0, 1.0, 0.5])
    u, v, d, _ = prepared.image_from_bev[0, 0].numpy() @ [*point_bev, 1]
    assert (u / d, v / d) == pytest.approx(1.5 * expected, abs=1e-3)


def test_images_are_enlarged_only_as_far_as_max_pixels_allows(mini_config):
    image = replace(mini_config.image, focal_px=120.0, max_pixels=4 * 3 * 160 * 90)
    assert image_for_rig(wide_rig(2.0, count=3), image).size == (320, 180)
    width, height = image_for_rig(wide_rig(2.0, count=6), image).size
    assert width * height * 6 == pytest.approx(image.max_pixels, rel=0.02)


def test_images_of_long_focal_lengths_keep_the_models_size(mini_config):
    image = replace(mini_config.image, focal_px=120.0, max_pixels=10**6)
    assert image_for_rig(wide_rig(0.5), image).size == mini_config.image.size
    assert image_for_rig(wide_rig(2.0), mini_config.image) is mini_config.image
    with pytest.raises(ValueError, match="must be given together"):
        replace(mini_config.image, focal_px=120.0)
    with pytest.raises(ValueError, match="exclude each other"):
        replace(image, crop=(0, 0, 10, 10))


def test_frames_with_images_of_different_sizes_form_one_batch(mini_config):
    config = replace(mini_config, image=replace(mini_config.image, focal_px=120.0, max_pixels=10**6))
    prepared = [Preprocessor(config)(MemoryDrive(rig=wide_rig(wide)).load(0)) for wide in (2.0, 1.0)]
    batch = joined_inputs([model_inputs(frame, None, config) for frame in prepared])
    assert batch.images.shape == (2, 3, 3, 288, 480)
    height, width = prepared[1].images.shape[-2:]
    torch.testing.assert_close(batch.images[1, ..., :height, :width], prepared[1].images[0])
    assert (batch.images[1, ..., height:, :] == 0).all()
    assert (batch.images[1, ..., width:] == 0).all()


INTERPOLATION = {"linear": cv2.INTER_LINEAR, "area": cv2.INTER_AREA}
MEAN, STD = np.array([103.5, 116.3, 123.7], np.float32), np.array([57.4, 57.1, 58.4], np.float32)
lengths = st.integers(1, 90)


def resized(pixels, width, height, method, **options):
    out = np.full((3, height + 2, width + 3), -7, np.float32)
    rows, columns = pixel_weights(len(pixels), height, method), pixel_weights(pixels.shape[1], width, method)
    resize_and_normalize(pixels, rows, columns, MEAN, STD, out, **{"reverse_channels": False} | options)
    assert (out[:, height:] == -7).all()  # the padding is left as it was
    assert (out[:, :, width:] == -7).all()
    return out[:, :height, :width]


def by_opencv(pixels, width, height, method):
    floats = cv2.resize(pixels.astype(np.float32), (width, height), interpolation=INTERPOLATION[method])
    return ((floats - MEAN) / STD).transpose(2, 0, 1)


@settings(max_examples=50, deadline=None)
@given(lengths, lengths, lengths, lengths, st.sampled_from(sorted(INTERPOLATION)), st.integers(0, 2**31))
def test_it_equals_opencv_for_any_size(width, height, new_width, new_height, method, seed):
    if method == "area":  # only for shrinking
        width, new_width = max(width, new_width), min(width, new_width)
        height, new_height = max(height, new_height), min(height, new_height)
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    expected = by_opencv(pixels, new_width, new_height, method)
    # OpenCV rounds positions in the image to float32.
    np.testing.assert_allclose(resized(pixels, new_width, new_height, method), expected, atol=1e-4)


def test_channels_are_reversed_and_any_memory_layout_is_read():
    pixels = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)[::2, 4:, ::-1]
    reversed_pixels = np.ascontiguousarray(pixels[..., ::-1])
    expected = by_opencv(reversed_pixels, 13, 7, "area")
    np.testing.assert_allclose(resized(pixels, 13, 7, "area", reverse_channels=True), expected, atol=5e-6)


def test_a_part_of_the_rows_and_columns_is_a_crop():
    pixels = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    rows, columns = pixel_weights(40, 20, "linear", 5, 15), pixel_weights(60, 30, "linear", 8, 20)
    out = np.zeros((3, 10, 12), np.float32)
    resize_and_normalize(pixels, rows, columns, MEAN, STD, out, reverse_channels=False)
    np.testing.assert_allclose(out, by_opencv(pixels, 30, 20, "linear")[:, 5:15, 8:20], atol=5e-6)


MODEL = tuple(NUSCENES_YAWS_DEG)


def test_known_names_take_the_models_order_not_the_rigs():
    rig = make_rig(dict(reversed(NUSCENES_YAWS_DEG.items())))
    assignment = assign_cameras(rig, MODEL)
    assert assignment.cameras == assignment.embeddings == MODEL


def test_unknown_names_go_by_viewing_direction():
    rig = make_rig({"nose": 4.0, "tail": -176.0, "left": 80.0, "right": -92.0})
    assignment = assign_cameras(rig, MODEL)
    given = dict(zip(assignment.cameras, assignment.embeddings, strict=True))
    assert given == {"nose": "CAM_FRONT", "tail": "CAM_BACK", "left": "CAM_FRONT_LEFT", "right": "CAM_BACK_RIGHT"}


def test_a_seventh_camera_shares_an_embedding_after_its_owner():
    assignment = assign_cameras(make_rig({**NUSCENES_YAWS_DEG, "extra": 2.0}), MODEL)
    assert assignment.cameras[:2] == ("CAM_FRONT", "extra")
    assert assignment.embeddings[:2] == ("CAM_FRONT", "CAM_FRONT")


def test_the_users_choice_goes_first_and_is_checked():
    rig = make_rig({"nose": 0.0})
    assert assign_cameras(rig, MODEL, {"nose": "CAM_BACK"}).embeddings == ("CAM_BACK",)
    with pytest.raises(InputError, match="tail"):
        assign_cameras(rig, MODEL, {"tail": "CAM_BACK"})
    with pytest.raises(InputError, match="CAM_TOP"):
        assign_cameras(rig, MODEL, {"nose": "CAM_TOP"})


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
