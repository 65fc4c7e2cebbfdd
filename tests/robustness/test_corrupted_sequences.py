"""Sequences with lost images, wrong calibration, wrong times, lost ego-motion, and lower rates."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from made_boxes import made_boxes
from memory_drive import MemoryDrive

from bevcli.frame import Frame
from bevcli.geometry.cameras import Distortion, camera_pose_noise
from bevcli.geometry.ego_motion import Kinematics
from bevcli.geometry.transforms import Pose, apply, inverse
from bevcli.workshop.robustness.conditions import (
    BodyPitch,
    CalibrationNoise,
    CameraCrash,
    Draws,
    EgoMotionLost,
    FrameLost,
    TimeOffsets,
    _turned,
    at_lower_rate,
    motion_during,
)
from bevcli.workshop.robustness.stress import split_scenes
from bevcli.workshop.synth.drives import FrameMemory, KeptFrames
from bevcli.workshop.synth.rig import nuscenes_like_rig, tilt

DRAWS = Draws(0, "test")


class WithTruth(MemoryDrive):
    """The noise drive with a parked car, in the world frame; counts how often a frame is read."""

    loads = 0

    def load(self, index: int) -> Frame:
        self.loads += 1
        car = made_boxes([(9.0, 2.0, 0.8)], sizes_lwh=(4.5, 2.0, 1.6), yaws=0.3, velocities=(0.4, 0.1))
        return replace(super().load(index), ground_truth=car)


def lost_cameras(frame: Frame) -> set[str]:
    return {name for name, image in frame.images.items() if not image.pixels_bgr.any()}


def test_a_crashed_camera_is_black_in_each_frame_also_at_harder():
    drive = MemoryDrive(3)
    lost = {}
    for level in (2, 4, 5):
        frames = [CameraCrash(drive, level, DRAWS, "black").load(place) for place in range(3)]
        each = [lost_cameras(frame) for frame in frames]
        assert each[0] == each[1] == each[2]
        assert 1 <= len(each[0]) <= level
        assert all(set(frame.images) == set(drive.rig.names) for frame in frames)
        lost[level] = each[0]
    assert lost[2] <= lost[4] <= lost[5]
    # Drawn with replacement, so that scenes may lose fewer.
    counts = {len(CameraCrash(drive, 2, Draws(seed, "test"), "black").lost(drive.load(0))) for seed in range(30)}
    assert counts == {1, 2}


def test_a_missing_image_is_left_out_and_reported():
    drive = MemoryDrive(1)
    black, missing = (CameraCrash(drive, 4, DRAWS, kind).load(0) for kind in ("black", "missing"))
    assert set(missing.dropped) == lost_cameras(black) == set(drive.rig.names) - set(missing.images)


@pytest.mark.parametrize("level", [2, 4, 5])
def test_frame_lost_loses_a_share_of_level_sixths(level):
    drive = MemoryDrive(1)
    frame, sequence = drive.load(0), FrameLost(drive, level, DRAWS, "black")
    frames = [replace(frame, stamp=replace(frame.stamp, index=index)) for index in range(400)]
    lost = sum(len(sequence.lost(each)) for each in frames)
    assert lost / 2400 == pytest.approx(level / 6, abs=0.03)


def test_calibration_noise_has_the_stated_spread_per_axis():
    level = 4
    noise = [camera_pose_noise(level, Draws(seed, "test").generator()) for seed in range(2000)]
    translations = np.array([each[:3, 3] for each in noise])
    # For small angles, the rotation about each axis is in the skew-symmetric part.
    skew = np.array([(each[:3, :3] - each[:3, :3].T) / 2 for each in noise])
    angles_deg = np.degrees(np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=-1))
    assert translations.std(axis=0) == pytest.approx(0.20, rel=0.06)
    assert angles_deg.var(axis=0) == pytest.approx(4.0, rel=0.1)


def test_calibration_noise_is_one_wrong_rig_a_scene_and_no_more():
    drive = MemoryDrive(4, scenes="aabb")
    noisy = CalibrationNoise(drive, 2, DRAWS)
    frames = [noisy.load(place) for place in range(4)]
    assert frames[0].rig is frames[1].rig  # so that maps of the lens are made once
    poses = [frame.rig["CAM_FRONT"].ego_from_camera for frame in frames]
    assert np.array_equal(poses[2], poses[3])
    assert not np.allclose(poses[1], poses[2], atol=1e-4)
    clean = drive.load(0)
    assert np.array_equal(frames[0].rig.ego_from_bev, clean.rig.ego_from_bev)
    assert np.array_equal(frames[0].images["CAM_BACK"].pixels_bgr, clean.images["CAM_BACK"].pixels_bgr)
    assert np.array_equal(frames[0].rig["CAM_BACK"].intrinsics, clean.rig["CAM_BACK"].intrinsics)


def test_a_wrong_capture_time_moves_the_camera_along_the_path():
    drive = MemoryDrive(2)
    clean, wrong = drive.load(1), TimeOffsets(drive, 200, DRAWS).load(1)
    offsets = {name: wrong.images[name].timestamp_ns - clean.images[name].timestamp_ns for name in drive.rig.names}
    assert len(set(offsets.values())) == 6
    assert max(map(abs, offsets.values())) <= 200_000_000
    for name, offset_ns in offsets.items():
        moved = inverse(clean.world_from_ego.matrix) @ wrong.world_from_ego_at[name].matrix
        assert moved[0, 3] == pytest.approx(6.0 * offset_ns / 1e9, abs=0.01)  # the drive has 6 m/s and 0.1 rad/s
        assert np.arctan2(moved[1, 0], moved[0, 0]) == pytest.approx(0.1 * offset_ns / 1e9, abs=1e-6)
    assert np.array_equal(wrong.world_from_ego.matrix, clean.world_from_ego.matrix)


def test_the_motion_during_a_time_is_that_of_many_short_steps():
    kinematics = Kinematics(np.zeros(3), np.array([0.02, -0.05, 0.6]), np.array([8.0, 0.3, 0.1]))
    steps = np.eye(4)
    for _ in range(1000):
        steps = steps @ motion_during(0.2 / 1000, kinematics)
    whole = motion_during(0.2, kinematics)
    assert np.abs(whole - steps).max() < 0.003
    assert np.allclose(whole @ motion_during(-0.2, kinematics), np.eye(4), atol=0.003)


def test_a_lost_pose_is_the_last_that_arrived_and_truth_stays():
    drive = WithTruth(10)
    stale = EgoMotionLost(drive, 4, DRAWS)
    clean, frames = [drive.load(place) for place in range(10)], [stale.load(place) for place in range(10)]
    poses = [frame.world_from_ego for frame in frames]
    assert np.array_equal(poses[0].matrix, clean[0].world_from_ego.matrix)
    held = 0
    for place in range(1, 10):
        own, last = clean[place].world_from_ego.matrix, poses[place - 1].matrix
        arrived = np.array_equal(poses[place].matrix, own)
        assert arrived or np.array_equal(poses[place].matrix, last)
        held += not arrived
        truths = [_in_ego(frame) for frame in (clean[place], frames[place])]
        assert truths[0] == pytest.approx(truths[1], abs=1e-9)
    assert 3 <= held <= 9
    backwards = [EgoMotionLost(drive, 4, DRAWS).load(place).world_from_ego.matrix for place in range(10)]
    assert np.array_equal([pose.matrix for pose in poses], backwards)
    drive = MemoryDrive(10, scenes="ababababab")  # the first frame of a scene keeps its pose
    stale = EgoMotionLost(drive, 5, DRAWS)
    assert all(np.array_equal(stale.load(k).world_from_ego.matrix, drive.pose(k).matrix) for k in range(10))


def _in_ego(frame: Frame) -> np.ndarray:
    assert frame.ground_truth is not None
    return frame.ground_truth.transformed(inverse(frame.world_from_ego.matrix)).to_numpy()


@pytest.mark.parametrize("step", [2, 3, 4])
def test_a_lower_rate_has_every_frame_once(step):
    parts = at_lower_rate(MemoryDrive(9), step)
    indices = [[stamp.index for stamp in part.stamps] for part in parts]
    assert sorted(index for part in indices for index in part) == list(range(9))
    assert all(later - earlier == step for part in indices for earlier, later in pairwise(part))
    scenes = split_scenes(MemoryDrive(5, scenes="aabbb"))  # which are run one by one
    assert [[stamp.scene for stamp in scene.stamps] for scene in scenes] == [["a", "a"], ["b", "b", "b"]]


def test_kept_frames_are_read_once_while_the_memory_lasts():
    drive = WithTruth(3)
    frame_bytes = sum(image.pixels_bgr.nbytes for image in drive.load(0).images.values())
    drive.loads = 0
    kept = KeptFrames(drive, FrameMemory(2 * frame_bytes), 0)
    for _ in range(3):
        for place in range(3):
            kept.load(place)
    assert drive.loads == 2 + 3
    assert isinstance(kept.load(0).world_from_ego, Pose)


@pytest.mark.parametrize("lens", [None, Distortion("brown_conrady", (-0.2, 0.05, 0.001, 0.0))])
def test_a_pitching_body_turns_images_about_their_cameras(lens):
    """A point that is far away is seen where the camera of a pitched vehicle sees it; poses and rig stay."""
    front = replace(nuscenes_like_rig(320, 180)["CAM_FRONT"], distortion=lens)
    far = apply(front.ego_from_camera, front.rays([[200.0, 80.0]]) * 1e4)
    pixels = np.zeros((180, 320, 3), np.uint8)
    pixels[79:82, 199:202] = 255
    turned = _turned(pixels, front, tilt(np.radians(2.0), np.radians(-1.0)))
    expected, _ = front.project_ego(far @ tilt(np.radians(2.0), np.radians(-1.0)))  # level_from_body.T @ point
    weights = turned[..., 0] / turned[..., 0].sum()
    found = [(weights * grid).sum() for grid in np.indices((180, 320))[::-1]]
    assert found == pytest.approx(expected[0].tolist(), abs=0.1)
    assert expected[0, 1] < 75  # the nose goes down, so what is ahead goes up in the image


def test_a_body_pitches_anew_in_each_frame_and_more_at_harder():
    drive = MemoryDrive(2)
    clean, frames = drive.load(0), {}
    for level in (1, 3):
        frames[level] = [BodyPitch(drive, level, DRAWS).load(place) for place in range(2)]
        assert frames[level][0].rig is clean.rig
        assert np.array_equal(frames[level][0].world_from_ego.matrix, clean.world_from_ego.matrix)
    before, after = (each.images["CAM_FRONT"].pixels_bgr for each in (clean, frames[1][0]))
    assert not np.array_equal(before, after)
    draws = [BodyPitch(drive, 1, DRAWS).random(drive.stamps[k], k).standard_normal(2) for k in range(2)]
    assert not np.allclose(draws[0], draws[1])
