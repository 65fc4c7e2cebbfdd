"""A session without poses: what it measures is used at once, and corrected when the next frame is there."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from memory_drive import MemoryDrive

import bevcli
from bevcli.errors import BevcliError, InputError
from bevcli.frame import FrameStamp, StartReason
from bevcli.geometry.transforms import Pose, inverse, rigid
from bevcli.model.bevformer import BEVFormer, BevHistory
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.temporal_model import TemporalModel
from bevcli.workshop.bevformer_v2 import BEVFormerV2, FeatureWindow, FrameFeatures
from bevcli.workshop.odometry import measure
from bevcli.workshop.odometry.measure import MeasuredStep

COUNT = 5


class Meter:
    """Tells each step of the drive one frame late. Until then it is `ahead` metres too long."""

    ahead = 0.0

    def __init__(self):
        drive = MemoryDrive(COUNT)
        poses = [drive.pose(place).matrix for place in range(COUNT)]
        self.steps = [inverse(a) @ b for a, b in pairwise(poses)]
        self.frames = 0

    def add(self, frame):
        self.frames += 1
        return [self.of(self.steps[self.frames - 3])] if self.frames > 2 else []

    @property
    def newest(self):
        return self.of(self.steps[self.frames - 2] @ rigid((self.ahead, 0, 0)), "too dark" if self.ahead else "")

    def of(self, step, reason=""):
        return MeasuredStep(step, np.eye(6), reason)


@pytest.fixture
def session(mini_model, monkeypatch):
    monkeypatch.setattr(measure, "MotionMeter", Meter)
    return bevcli.Session(bevcli.Model(mini_model), MemoryDrive(1).rig)


def images_of(frame):
    return {name: image.pixels_bgr for name, image in frame.images.items()}


def path(drive):
    """The poses of a drive in the ego frame of its first frame."""
    first = inverse(drive.pose(0).matrix)
    return [first @ drive.pose(place).matrix for place in range(COUNT)]


def test_a_session_without_poses_is_one_with_the_measured_ones(session, mini_model):
    drive = MemoryDrive(COUNT)
    given = bevcli.Session(bevcli.Model(mini_model), drive.rig)
    for place, pose in enumerate(path(drive)):
        frame = drive.load(place)
        found = session.step(images_of(frame), None, frame.stamp.timestamp_ns)
        expected = given.step(images_of(frame), pose, frame.stamp.timestamp_ns)
        np.testing.assert_allclose(found.world_from_ego.matrix, pose, atol=1e-12)
        np.testing.assert_allclose(found.boxes.centers, expected.boxes.centers, atol=1e-4)
        for name in ("acceleration", "angular_rate", "velocity"):
            found_value, value = (getattr(each.frame.kinematics, name) for each in (session, given))
            np.testing.assert_allclose(found_value, value, atol=1e-9)


def test_the_history_gets_the_corrected_pose(session, monkeypatch):
    monkeypatch.setattr(Meter, "ahead", 0.5)
    drive, histories, step = MemoryDrive(COUNT), [], session._runner.step

    def spy(state, prepared):
        histories.append(state.memory and state.memory.pose.matrix)
        return step(state, prepared)

    monkeypatch.setattr(session._runner, "step", spy)
    for place, pose in enumerate(path(drive)):
        frame = drive.load(place)
        session.step(images_of(frame), None, frame.stamp.timestamp_ns)
        told = session.frame.world_from_ego.matrix
        assert np.linalg.norm(told[:3, 3] - pose[:3, 3]) == pytest.approx(0.5 * (place > 0))
        if place:
            np.testing.assert_allclose(histories[place], path(drive)[place - 1], atol=1e-9)
            assert session.motion.reason == "too dark"


def test_poses_for_some_frames_only_are_refused(session):
    frame = MemoryDrive(1).load(0)
    session.step(images_of(frame), None, 0)
    with pytest.raises(InputError, match="is a pose, but for the frame before it was None"):
        session.step(images_of(frame), np.eye(4), 1)
    session.reset()
    session.step(images_of(frame), np.eye(4), 2)
    with pytest.raises(InputError, match="is None, but for the frame before it was a pose"):
        session.step(images_of(frame), None, 3)
    with pytest.raises(InputError, match="`world_from_ego_at`: needs `world_from_ego`"):
        session.step(images_of(frame), None, 3, world_from_ego_at={"CAM_FRONT": np.eye(4)})
    assert session.motion is None


def test_a_reset_and_a_gap_begin_a_new_world(session):
    drive = MemoryDrive(2)
    for time, place in enumerate((0, 1)):
        session.step(images_of(drive.load(place)), None, time)
    assert np.linalg.norm(session.frame.world_from_ego.translation) > 1
    session.reset()
    session.step(images_of(drive.load(0)), None, 0)
    np.testing.assert_array_equal(session.frame.world_from_ego.matrix, np.eye(4))
    for time in (10**9, 60 * 10**9):
        prediction = session.step(images_of(drive.load(0)), None, time)
    assert prediction.started_anew.reason is StartReason.GAP
    np.testing.assert_array_equal(prediction.world_from_ego.matrix, np.eye(4))


def test_the_newest_pose_of_a_memory_is_exchanged(mini_config):
    old, new = Pose.identity(), Pose(np.ones(3), np.array([1.0, 0, 0, 0]))
    assert BEVFormer.with_pose(None, BevHistory(torch.zeros(1), old), new).pose is new
    features, cameras = FeatureMaps(torch.zeros(1), ()), [torch.zeros(1)] * 2
    frames = tuple(FrameFeatures(FrameStamp(index, "", index), old, features, *cameras) for index in (0, 1))
    assert [frame.pose for frame in BEVFormerV2.with_pose(None, FeatureWindow(frames), new).frames] == [old, new]
    assert BEVFormerV2.with_pose(None, FeatureWindow(()), new) == FeatureWindow(())
    with pytest.raises(BevcliError, match="has no `with_pose`"):
        TemporalModel(mini_config).with_pose("memory", new)


@pytest.mark.slow
def test_the_motion_of_the_sample_drive_is_measured_live():
    drive = bevcli.open_sequence(Path(__file__).parents[2] / "samples/street", frames=slice(8, 14), ground_truth=False)
    session = bevcli.Session(bevcli.load_model("demo"), drive.rig)
    first = None
    for place, stamp in enumerate(drive.stamps):
        frame = drive.load(place)
        first = inverse(frame.world_from_ego.matrix) if first is None else first
        session.step(images_of(frame), None, stamp.timestamp_ns)
        off = inverse(first @ frame.world_from_ego.matrix) @ session.frame.world_from_ego.matrix
        assert np.linalg.norm(off[:3, 3]) < 0.2
        assert not session.motion or not session.motion.reason
        if place:
            speed = np.linalg.norm(frame.kinematics.velocity)
            assert np.linalg.norm(session.frame.kinematics.velocity) == pytest.approx(speed, rel=0.3, abs=0.3)
