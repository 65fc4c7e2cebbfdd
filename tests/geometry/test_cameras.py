from dataclasses import replace

import cv2
import numpy as np
import pytest

from bevcli.geometry.cameras import Camera, Distortion, default_ego_from_bev
from bevcli.geometry.transforms import apply, rigid, rotation_about_z

INTRINSICS = np.array([[500.0, 0, 400], [0, 510, 300], [0, 0, 1]])
LOOKING_FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # ego_from_camera rotation
BROWN = (-0.3, 0.1, 0.001, -0.002, 0.01)
FISHEYE = (0.02, -0.01, 0.003, -0.001)


def camera(distortion=None):
    return Camera("CAM", 800, 600, INTRINSICS, rigid((1.5, 0, 1.6), LOOKING_FORWARD), distortion)


def points_in_view(count=200):
    return np.random.default_rng(2).uniform([-2, -1, 3], [2, 1, 9], size=(count, 3))


def test_point_straight_ahead_falls_on_the_principal_point():
    pixels, depth = camera().project_ego([11.5, 0, 1.6])
    assert pixels == pytest.approx([400, 300])
    assert depth == pytest.approx(10)


def test_pinhole_agrees_with_opencv():
    expected = cv2.projectPoints(points_in_view(), np.zeros(3), np.zeros(3), INTRINSICS, None)[0][:, 0]
    assert camera().project(points_in_view())[0] == pytest.approx(expected)


@pytest.mark.parametrize("coefficients", [BROWN[:4], BROWN, (*BROWN, 0.02, 0.01, 0.003)])
def test_brown_conrady_agrees_with_opencv(coefficients):
    lens = Distortion("brown_conrady", coefficients)
    expected = cv2.projectPoints(points_in_view(), np.zeros(3), np.zeros(3), INTRINSICS, np.array(coefficients))[0]
    assert camera(lens).project(points_in_view())[0] == pytest.approx(expected[:, 0], abs=1e-9)


def test_kannala_brandt_agrees_with_opencv():
    points = points_in_view() * [3, 3, 1]
    expected = cv2.fisheye.projectPoints(points[None], np.zeros(3), np.zeros(3), INTRINSICS, np.array(FISHEYE))[0]
    assert camera(Distortion("kannala_brandt", FISHEYE)).project(points)[0] == pytest.approx(expected[0], abs=1e-9)


def test_points_behind_the_camera_have_no_pixel():
    pixels, depth = camera().project([[0.0, 0, -5], [0, 0, 0], [0, 0, 5]])
    assert np.isnan(pixels[:2]).all()
    assert camera().contains(pixels, depth).tolist() == [False, False, True]


def test_distortion_not_monotonic_gives_no_pixel_past_its_limit():
    pixels, _ = camera(Distortion("brown_conrady", (-0.3, 0, 0, 0))).project([[8.0, 0, 4]])
    assert np.isnan(pixels).all()


LENSES = [Distortion("brown_conrady", BROWN), Distortion("kannala_brandt", FISHEYE)]


@pytest.mark.parametrize("lens", LENSES)
def test_undistortion_agrees_with_opencv(lens):
    """Two images, because the camera keeps its maps. Their colours change slowly, so rounding of maps is small."""
    one_camera = camera(lens)
    u, v = np.meshgrid(np.arange(800), np.arange(600))
    for phase in (0, 1):
        waves = [np.sin(u / 40 + phase), np.cos(v / 50 + phase), np.sin((u + v) / 60)]
        image = (127 + 100 * np.stack(waves, axis=-1)).astype(np.uint8)
        coefficients = np.array(lens.coefficients)
        if lens.model == "kannala_brandt":
            expected = cv2.fisheye.undistortImage(image, INTRINSICS, coefficients, Knew=INTRINSICS)
        else:
            expected = cv2.undistort(image, INTRINSICS, coefficients)
        difference = np.abs(one_camera.undistort(image).astype(int) - expected)
        assert np.median(difference) <= 1
        assert np.percentile(difference, 99) <= 2


def test_image_of_a_camera_without_distortion_stays_as_it_is():
    image = np.random.default_rng(4).integers(0, 255, (600, 800, 3), dtype=np.uint8)
    assert camera().undistort(image) is image


@pytest.mark.parametrize("lens", LENSES)
def test_no_points_have_no_rays(lens):
    assert camera(lens).rays(np.zeros((0, 2))).shape == (0, 3)


@pytest.mark.parametrize("lens", LENSES)
def test_distorted_pixels_are_those_of_the_same_ray(lens):
    pinhole, _ = camera().project(points_in_view())
    expected, _ = camera(lens).project(points_in_view())
    assert camera(lens).distorted(pinhole) == pytest.approx(expected, abs=1e-9)


def test_pixels_scale_with_the_image():
    pixels, _ = camera().project(points_in_view())
    half = camera().scaled(0.5)
    assert half.project(points_in_view())[0] == pytest.approx(pixels / 2)
    assert (half.width, half.height) == (400, 300)


@pytest.mark.parametrize("yaw_deg", [0, 55, -110, 180])
def test_yaw_is_the_viewing_direction(yaw_deg):
    mounted = rigid((1.5, 0, 1.6), rotation_about_z(np.radians(yaw_deg)) @ LOOKING_FORWARD)
    assert np.degrees(replace(camera(), ego_from_camera=mounted).yaw) == pytest.approx(yaw_deg)


def test_default_bev_frame_has_y_ahead_and_x_to_the_right():
    assert apply(default_ego_from_bev(), [[0.0, 10, 0], [3, 0, 0]]) == pytest.approx(
        np.array([[10.94, 0, 1.84], [0.94, -3, 1.84]])
    )
