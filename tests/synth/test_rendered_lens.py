"""An undistorted rendering of a camera with a known lens resembles the rendering without a lens."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from same_world import with_rig

from bevcli.errors import InputError
from bevcli.geometry.cameras import CameraRig, Distortion
from bevcli.geometry.transforms import rigid

LENSES = {
    "brown_conrady": Distortion("brown_conrady", (-0.2, 0.05, 0.001, -0.0005)),
    "kannala_brandt": Distortion("kannala_brandt", (0.03, -0.01, 0.002, -0.0005)),
}


def rendered(drive, lens, **changes):
    """An image of CAM_FRONT with the given distortion and other changes of the camera, and this camera."""
    camera = replace(drive.rig["CAM_FRONT"], distortion=lens, **changes)
    one = with_rig(drive, CameraRig((camera,), drive.rig.ego_from_bev))
    return one.frame(9).images["CAM_FRONT"].astype(np.float64), camera


@pytest.mark.parametrize("name", LENSES)
def test_undistorted_rendering_resembles_one_without_a_lens(drive, name):
    plain, _ = rendered(drive, None)
    bent, camera = rendered(drive, LENSES[name])
    mended = camera.undistort(bent.astype(np.uint8)).astype(np.float64)
    seen = mended.sum(-1) > 0  # black where the lens saw nothing
    assert seen.mean() > 0.85
    before, after = np.abs(bent - plain)[seen].mean(), np.abs(mended - plain)[seen].mean()
    assert after < 0.4 * before


FISHEYE = Distortion("kannala_brandt", (0.02, -0.005, 0.001, -0.0003))
EQUIDISTANT = Distortion("kannala_brandt", (0.0, 0.0, 0.0, 0.0))


def square(focal):
    return {"width": 320, "height": 320, "intrinsics": np.array([[focal, 0, 160], [0, focal, 160], [0, 0, 1.0]])}


@pytest.fixture(scope="module")
def fisheye_of_180_degrees(drive):
    return rendered(drive, FISHEYE, **square(100.0))


@pytest.mark.parametrize(("right_deg", "down_deg"), [(45, 0), (-68, 0), (68, 10), (0, -55), (-30, 45)])
def test_a_fisheye_of_180_degrees_agrees_with_a_turned_pinhole(drive, fisheye_of_180_degrees, right_deg, down_deg):
    fisheye, camera = fisheye_of_180_degrees
    turn = cv2.Rodrigues(np.radians([0.0, right_deg, 0]))[0] @ cv2.Rodrigues(np.radians([-down_deg, 0.0, 0]))[0]
    turned = camera.ego_from_camera @ rigid((0, 0, 0), turn)
    narrow, pinhole = rendered(drive, None, **{**square(450.0), "ego_from_camera": turned})
    u, v = np.meshgrid(np.arange(320.0), np.arange(320.0))
    directions = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3) @ np.linalg.inv(pinhole.intrinsics).T @ turn.T
    assert directions[:, 2].min() > 0  # OpenCV projects what is less than 90 degrees off the axis
    places, _ = cv2.fisheye.projectPoints(
        directions[None], np.zeros(3), np.zeros(3), camera.intrinsics, np.array(FISHEYE.coefficients)
    )
    seen = cv2.remap(fisheye, places.reshape(320, 320, 2).astype(np.float32), None, cv2.INTER_LINEAR)
    coarse = cv2.GaussianBlur(narrow, (0, 0), 3)  # the fisheye has a fourth of the resolution
    assert np.abs(seen - coarse).mean() < 8
    assert np.corrcoef(cv2.GaussianBlur(seen, (0, 0), 3).ravel(), coarse.ravel())[0, 1] > 0.95


def test_a_fisheye_is_black_beyond_120_degrees_only(drive):
    image, _ = rendered(drive, EQUIDISTANT, **square(60.0))
    u, v = np.meshgrid(np.arange(320) - 160, np.arange(320) - 160)
    angle_deg = np.degrees(np.hypot(u, v) / 60.0)
    assert (image[angle_deg > 121] == 0).all()
    assert (image[angle_deg < 119].sum(-1) > 0).all()


def test_a_lens_model_that_ends_inside_the_image_is_an_error(drive):
    with pytest.raises(InputError, match="its lens model ends 27 degrees off the optical axis"):
        rendered(drive, Distortion("kannala_brandt", (-1.5, 0.0, 0.0, 0.0)), **square(100.0))
