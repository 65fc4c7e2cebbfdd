"""Rigs drawn at random, cameras that take their images at different times, and cameras with a lens."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from same_world import with_rig

from bevcli.config import TRAINING, settings_of_table
from bevcli.errors import ConfigError, InputError
from bevcli.frame import Frame
from bevcli.geometry.cameras import CameraRig, Distortion
from bevcli.geometry.transforms import apply, inverse, rigid
from bevcli.sequences.open import open_sequence
from bevcli.workshop.synth.catalog import Assets
from bevcli.workshop.synth.drive import RenderedDrive, RenderedFrame, export_drive
from bevcli.workshop.synth.rig import DrawnRig, RigDistribution, draw_rig, nuscenes_like_rig, rig_for_rendering
from bevcli.workshop.training.job import TrainingConfig

SIZE = (512, 288)
RANDOM = RigDistribution(random_share=1.0)


def fov_deg(camera):
    return np.degrees(2 * np.arctan(camera.width / 2 / camera.intrinsics[0, 0]))


def test_rigs_lie_in_the_ranges_of_the_distribution():
    rigs = [draw_rig(RANDOM, seed, SIZE).rig for seed in range(60)]
    assert {len(rig.cameras) for rig in rigs} == {4, 5, 6, 7, 8}
    cameras = [camera for rig in rigs for camera in rig.cameras]
    assert all(camera.width <= 512 and camera.height <= 288 for camera in cameras)
    assert all(44.9 <= fov_deg(camera) <= 110.1 for camera in cameras)
    heights = [camera.ego_from_camera[2, 3] for camera in cameras]
    assert 0.8 <= min(heights) < 1.0
    assert 2.6 < max(heights) <= 2.8
    pitches = [np.degrees(np.arcsin(camera.ego_from_camera[2, 2])) for camera in cameras]
    assert 2.5 < np.abs(pitches).max() <= 3.01
    tilts = [np.degrees(np.arccos(rig.ego_from_bev[2, 2])) for rig in rigs]
    assert 1.5 < max(tilts) <= 2.84  # 2 degrees about two axes
    assert any(camera.distortion for camera in cameras)
    lenses = RigDistribution(random_share=1.0, distorted_share=1.0)
    for seed in range(30):  # the renderer refuses lenses that see too much
        rig_for_rendering(draw_rig(lenses, seed, (64, 36)).rig, None)
    first, again = (draw_rig(RANDOM, 5, SIZE) for _ in range(2))
    assert [c.intrinsics.tolist() for c in first.rig.cameras] == [c.intrinsics.tolist() for c in again.rig.cameras]
    assert (first.delays_s, first.jpeg_quality) == (again.delays_s, again.jpeg_quality)


def test_a_rig_that_looks_all_around_has_no_gap_between_cameras():
    level = RigDistribution(random_share=1.0, front_share=0.0, yaw_jitter_deg=0.0, fov_spread=0.0)
    for seed in range(50):
        rig = draw_rig(level, seed, SIZE).rig
        assert sum(fov_deg(camera) for camera in rig.cameras) >= 359.9


def test_the_share_of_random_rigs_is_as_asked_for():
    half = RigDistribution(random_share=0.5)
    own = [draw_rig(half, seed, SIZE).rig.names == nuscenes_like_rig().names for seed in range(300)]
    assert 0.4 < np.mean(own) < 0.6


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"random_share": 1.5}, '"training.rigs.random_share" must be a number from 0 to 1, but is 1.5'),
        ({"fov_deg": [90.0, 60.0]}, "fov_deg goes from a smaller to a larger"),
        ({"cameras": [0, 3]}, 'cameras" must be a list of 2, each element an integer from 1 to 16'),
        ({"delay_s": 1.0}, 'delay_s" must be a number from 0 to 0.1'),
        ({"aspects": []}, "aspects must not be empty"),
    ],
)
def test_a_wrong_distribution_is_rejected(wrong, message):
    with pytest.raises(ConfigError, match=message):
        settings_of_table({TRAINING: {"rigs": wrong}}, TRAINING, TrainingConfig, "own.toml")


@pytest.fixture(scope="module")
def delayed(tmp_path_factory: pytest.TempPathFactory, assets: Assets) -> tuple[RenderedDrive, Frame, RenderedFrame]:
    """A drive whose left front camera takes its images 50 ms late; a frame of it, as it is read and as rendered."""
    folder = tmp_path_factory.mktemp("delayed") / "drive"
    delays = {"CAM_FRONT_LEFT": 0.05}
    drive = RenderedDrive(5, frames=2, rig=DrawnRig(nuscenes_like_rig(160, 90), delays), assets=assets)
    export_drive(drive, folder)
    return drive, open_sequence(folder).load(1), drive.frame(1)


@pytest.mark.slow
def test_a_late_camera_has_its_own_time_and_pose(delayed, rendered: RenderedFrame):
    drive, frame, of_late = delayed
    np.testing.assert_array_equal(of_late.images["CAM_BACK"], rendered.images["CAM_BACK"])
    assert (of_late.images["CAM_FRONT_LEFT"] != rendered.images["CAM_FRONT_LEFT"]).any()
    assert frame.images["CAM_FRONT_LEFT"].timestamp_ns - frame.stamp.timestamp_ns == 50_000_000
    assert frame.images["CAM_FRONT"].timestamp_ns == frame.stamp.timestamp_ns
    expected = drive.world_from_ego(0.55)
    np.testing.assert_allclose(frame.world_from_ego_at["CAM_FRONT_LEFT"].translation, expected.translation, atol=2e-3)


def test_a_late_camera_sees_objects_where_they_are_then(delayed: tuple[RenderedDrive, Frame, RenderedFrame]):
    drive, _, rendered = delayed
    camera, boxes = drive.rig["CAM_FRONT_LEFT"], rendered.boxes
    view = rendered.views["CAM_FRONT_LEFT"]
    # Pixels of an object lie around its projected centre at the time of the image.
    states = [state for _, state in drive._actors(1)]
    pose = rendered.world_from_ego_at["CAM_FRONT_LEFT"]
    compared = 0
    for index, state in enumerate(states):
        rows, columns = np.nonzero(view.objects == index)
        near = boxes.instances == state.body.instance
        if len(rows) < 8 or not near.any() or view.visible[index] < 0.9 * view.unoccluded[index]:
            continue
        center = boxes.centers[near][0] + [*(boxes.velocities[near][0] * 0.05), 0]
        (u, v), _ = camera.project(apply(camera.camera_from_ego @ inverse(pose.matrix), center))
        inside = columns.min() > 1 and columns.max() < camera.width - 2
        if inside:
            assert (columns.mean(), rows.mean()) == pytest.approx((u, v), abs=0.3 * np.ptp(columns) + 2)
            compared += 1
    assert compared


LENSES = {
    "brown_conrady": Distortion("brown_conrady", (-0.2, 0.05, 0.001, -0.0005)),
    "kannala_brandt": Distortion("kannala_brandt", (0.03, -0.01, 0.002, -0.0005)),
}


def with_lens(drive, lens, **changes):
    """An image of CAM_FRONT with the given distortion and other changes of the camera, and this camera."""
    camera = replace(drive.rig["CAM_FRONT"], distortion=lens, **changes)
    one = with_rig(drive, CameraRig((camera,), drive.rig.ego_from_bev))
    return one.frame(9).images["CAM_FRONT"].astype(np.float64), camera


@pytest.mark.slow
@pytest.mark.parametrize("name", LENSES)
def test_undistorted_rendering_resembles_one_without_a_lens(drive, name):
    plain, _ = with_lens(drive, None)
    bent, camera = with_lens(drive, LENSES[name])
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
    return with_lens(drive, FISHEYE, **square(100.0))


@pytest.mark.parametrize(("right_deg", "down_deg"), [(45, 0), (-68, 0), (68, 10), (0, -55), (-30, 45)])
def test_a_fisheye_of_180_degrees_agrees_with_a_turned_pinhole(drive, fisheye_of_180_degrees, right_deg, down_deg):
    fisheye, camera = fisheye_of_180_degrees
    turn = cv2.Rodrigues(np.radians([0.0, right_deg, 0]))[0] @ cv2.Rodrigues(np.radians([-down_deg, 0.0, 0]))[0]
    turned = camera.ego_from_camera @ rigid((0, 0, 0), turn)
    narrow, pinhole = with_lens(drive, None, **{**square(450.0), "ego_from_camera": turned})
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
    image, _ = with_lens(drive, EQUIDISTANT, **square(60.0))
    u, v = np.meshgrid(np.arange(320) - 160, np.arange(320) - 160)
    angle_deg = np.degrees(np.hypot(u, v) / 60.0)
    assert (image[angle_deg > 121] == 0).all()
    assert (image[angle_deg < 119].sum(-1) > 0).all()
    with pytest.raises(InputError, match="its lens model ends 27 degrees off the optical axis"):
        with_lens(drive, Distortion("kannala_brandt", (-1.5, 0.0, 0.0, 0.0)), **square(100.0))
