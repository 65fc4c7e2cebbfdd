"""Images and projections of a frame for the network; resizing and normalising in one pass equals OpenCV's."""

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
from bevcli.inference.preprocess import Preprocessor, image_for_rig, pixel_weights, resize_and_normalize
from bevcli.model.step import assign_cameras, joined_inputs, model_inputs


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
