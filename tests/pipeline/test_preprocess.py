from dataclasses import replace

import cv2
import numpy as np
import pytest
from memory_drive import MemorySequence, WithoutImages, make_camera, make_rig

from bevcli.geometry.cameras import CameraRig, Distortion
from bevcli.geometry.transforms import Pose, apply, inverse
from bevcli.pipeline.preprocess import Preprocessor


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
    frame = MemorySequence().load(1)
    images = Preprocessor(config)(frame).images[0].numpy()
    expected = [textbook_image(frame.images[name].pixels_bgr, config.image) for name in config.cameras]
    assert images == pytest.approx(np.stack(expected), abs=1e-5)


def test_area_resizing_averages_pixels(mini_config):
    """Stripes that are finer than the network's pixels become grey."""
    config = replace(mini_config, image=replace(mini_config.image, resize="area"))
    frame = MemorySequence().load(1)
    name = config.cameras[0]
    stripes = np.zeros_like(frame.images[name].pixels_bgr)
    stripes[:, ::2] = 200  # a network pixel covers two by two pixels
    frame = replace(frame, images={**frame.images, name: replace(frame.images[name], pixels_bgr=stripes)})
    image = Preprocessor(config)(frame).images[0, 0].numpy()
    width, height = config.image.size
    mean, std = (np.array(values)[:, None, None] for values in (config.image.mean, config.image.std))
    expected = np.broadcast_to((100 - mean) / std, (3, height, width))
    assert image[:, :height, :width] == pytest.approx(expected, abs=1e-4)


def test_projection_uses_the_pose_at_each_cameras_time(mini_config):
    frame = MemorySequence().load(1)
    late = Pose(frame.world_from_ego.translation + [1.5, 0, 0], frame.world_from_ego.quaternion)
    frame = replace(frame, world_from_ego_at={**frame.world_from_ego_at, "CAM_FRONT": late})
    point_bev = np.array([2.0, 15.0, -1.0])
    point_world = apply(frame.world_from_ego.matrix @ frame.rig.ego_from_bev, point_bev)
    expected, depth = frame.rig["CAM_FRONT"].project_ego(apply(inverse(late.matrix), point_world))
    u, v, d, one = Preprocessor(mini_config)(frame).image_from_bev[0, 0].numpy() @ [*point_bev, 1]
    assert (u / d, v / d) == pytest.approx(expected * 0.5, abs=1e-3)  # 320 pixels become 160
    assert (d, one) == pytest.approx((float(depth), 1.0), abs=1e-4)


def test_image_of_another_aspect_ratio_is_fitted_with_its_calibration(mini_config):
    camera = make_camera("CAM_FRONT", 0, width=300, height=300)
    sequence = MemorySequence(rig=CameraRig((camera,), make_rig().ego_from_bev))
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


def test_images_of_different_sizes_form_one_batch(mini_config):
    cameras = (make_camera("CAM_FRONT", 0, 320, 180), make_camera("CAM_BACK", 180, 640, 400))
    sequence = MemorySequence(rig=CameraRig(cameras, make_rig().ego_from_bev))
    prepared = Preprocessor(mini_config)(sequence.load(0))
    assert prepared.images.shape == (1, 2, 3, 96, 160)
    assert prepared.scales == (0.5, 90 / 400)


def test_images_are_undistorted_before_resizing(mini_config):
    lens = Distortion("kannala_brandt", (0.05, -0.01, 0.0, 0.0))
    plain = make_camera("CAM_FRONT", 0)
    bent = replace(plain, distortion=lens)
    point_ego = np.array([12.0, 5.0, 3.5])
    drawn = np.zeros((180, 320, 3), np.uint8)
    seen, _ = bent.project_ego(point_ego)
    cv2.circle(drawn, np.round(seen * 16).astype(int).tolist(), 5 * 16, (255, 255, 255), -1, shift=4)
    sequence = MemorySequence(rig=CameraRig((bent,), make_rig().ego_from_bev))
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


def test_projections_follow_the_resized_image_to_a_fraction_of_a_pixel(mini_config):
    """A bright spot, resized to a quarter, lies where its ray is projected to."""
    config = replace(mini_config, image=replace(mini_config.image, resize="area", half_pixel_shift=True))
    camera = make_camera("CAM_FRONT", 0, width=640, height=384)
    sequence = MemorySequence(rig=CameraRig((camera,), make_rig().ego_from_bev))
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
