"""The option and the command `odometry`: drives, runs, conversions, and a session without poses.

The measurement is replaced by the true motion; tests of the measurement itself are in test_measure.py.
"""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import MINI_TOML, command
from memory_drive import MemoryDrive
from true_motion import STREET, motion_of, street_copy

import bevcli
from bevcli.errors import BevcliError, InputError
from bevcli.frame import FrameStamp, StartReason
from bevcli.geometry.transforms import Pose, inverse, rigid
from bevcli.model.bevformer import BEVFormer, BevHistory
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.temporal_model import TemporalModel
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes
from bevcli.sequences.open import DriveView, open_steps
from bevcli.sequences.options import InputOptions
from bevcli.workshop.batch.job import Job
from bevcli.workshop.bevformer_v2 import BEVFormerV2, FeatureWindow, FrameFeatures
from bevcli.workshop.odometry import measure, report
from bevcli.workshop.odometry.measure import MeasuredStep
from bevcli.workshop.odometry.report import MOST_RATE_HZ, at_most_rate, with_measured_motion
from bevcli.workshop.scores.inputs import pair_frames

FRAMES = 4


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A drive without poses."""
    return street_copy(tmp_path_factory.mktemp("street") / "drive", FRAMES)


@pytest.fixture(scope="module")
def true_motion():
    return motion_of(bevcli.open_sequence(STREET, frames=slice(0, FRAMES), ground_truth=False))


@pytest.fixture
def measuring(monkeypatch, true_motion):
    """Drives that were measured. A measurement gives the true motion."""
    seen = []

    def measured(drive):
        seen.append(drive)
        indices = np.searchsorted(true_motion.timestamps_ns, [stamp.timestamp_ns for stamp in drive.stamps])
        for a, b in pairwise(true_motion.poses[indices]):
            yield replace(true_motion.steps[0], ego_a_from_ego_b=inverse(a) @ b)

    monkeypatch.setattr(report, "measure_steps", measured)
    return seen


def test_a_drive_without_poses_gets_those_that_are_measured(folder, measuring):
    *steps, drive = open_steps(folder, odometry=True)
    stated = bevcli.open_sequence(STREET)
    assert drive.has_ego_motion
    assert drive.facts.motion_measured
    first = inverse(stated.load(0).world_from_ego.matrix)
    for place in range(FRAMES):
        frame, other = drive.load(place), stated.load(place)
        assert frame.world_from_ego.matrix == pytest.approx(first @ other.world_from_ego.matrix, abs=1e-6)
        assert set(frame.world_from_ego_at) == set(drive.rig.names)
    assert drive.load(2).kinematics.velocity[0] > 1
    assert steps == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert [note for note in drive.notes if "measured from the images" in note]
    assert not [note for note in drive.notes if "ego frame" in note]


def test_true_boxes_stay_where_they_are_seen_from_the_vehicle(measuring):
    """In the world of the measured motion, which is another one."""
    drive, stated = (bevcli.open_sequence(STREET, frames=slice(0, 4), odometry=on) for on in (True, False))
    for of in (DriveView.load, DriveView.ground_truth_frame):
        frame, other = of(drive, 3), stated.load(3)
        a, b = (each.ground_truth.transformed(inverse(each.world_from_ego.matrix)) for each in (frame, other))
        assert a.centers == pytest.approx(b.centers, abs=1e-6)
        assert a.velocities == pytest.approx(b.velocities, abs=1e-6, nan_ok=True)
        assert np.linalg.norm(frame.ground_truth.centers - other.ground_truth.centers, axis=-1).min() > 1


def test_frames_between_those_that_are_used_are_measured_too(folder, measuring):
    drive = bevcli.open_sequence(folder, odometry=True, every=2)
    assert len(drive.stamps) == 2
    assert [len(each.stamps) for each in measuring] == [3]
    first, third = (bevcli.open_sequence(STREET).load(index).world_from_ego.matrix for index in (0, 2))
    assert drive.load(1).world_from_ego.matrix == pytest.approx(inverse(first) @ third, abs=1e-6)
    bevcli.open_sequence(folder, odometry=True, frames=slice(1, 3))  # those outside of a range are not
    assert [stamp.index for stamp in measuring[1].stamps] == [1, 2]
    with pytest.raises(InputError, match="exclude each other"):
        bevcli.open_sequence(STREET, ego_motion="static", odometry=True)
    assert Job("runs/fleet", source=InputOptions(odometry=True)).open(folder, None).has_ego_motion
    assert len(measuring) == 3


def test_a_fast_drive_is_thinned(folder):
    fast = MemoryDrive(9, scenes="a" * 9, step_s=1 / 30)
    assert [stamp.index for stamp in at_most_rate(fast).stamps] == [0, 3, 6]
    slow = MemoryDrive(4, step_s=1 / MOST_RATE_HZ)
    assert at_most_rate(slow) is slow


def test_scenes_have_motions_of_their_own(monkeypatch):
    drive = MemoryDrive(5, scenes="aabbb")
    monkeypatch.setattr(report, "measure_steps", lambda scene: iter(motion_of(scene).steps))
    *_, found = with_measured_motion(drive, drive)
    assert found.has_ego_motion
    assert len(found.notes) == 2
    for place, first in ((0, 0), (1, 0), (2, 2), (4, 2)):
        expected = inverse(drive.load(first).world_from_ego.matrix) @ drive.load(place).world_from_ego.matrix
        assert found.load(place).world_from_ego.matrix == pytest.approx(expected, abs=1e-6)


def test_a_drive_without_poses_names_the_option(folder, tmp_path):
    (tmp_path / "mini.toml").write_text(MINI_TOML)
    done = command(tmp_path, "run", str(folder), "--model", "mini.toml", "--untrained")
    assert done.returncode == 1
    assert "ego_motion.csv: the file is missing" in done.stderr
    assert "pass `odometry=True` (`--odometry`) to measure them from the images, " in done.stderr


def test_a_run_measures_first_and_says_so(folder, tmp_path, measuring):
    (tmp_path / "mini.toml").write_text(MINI_TOML)
    options = ("--model", "mini.toml", "--untrained", "--record", "minimal", "--out", "out")
    done = command(tmp_path, "run", str(folder), *options, "--odometry")
    assert done.returncode == 0, done.stderr
    assert "3/3 steps of the ego-motion" in done.stderr
    assert "the ego-motion is measured from the images" in done.stderr
    predictions = (tmp_path / "out/predictions.json").read_text()
    assert '"frame_of_reference": "world"' in predictions
    assert '"ego_motion": "measured"' in predictions


def test_a_conversion_writes_the_measured_poses(folder, tmp_path, measuring, true_motion):
    done = command(tmp_path, "convert", str(folder), "out", "--odometry")
    assert done.returncode == 0, done.stderr
    again = bevcli.open_sequence(tmp_path / "out")
    assert again.load(3).world_from_ego.matrix == pytest.approx(true_motion.poses[3], abs=1e-6)
    assert len(again.load(0).ground_truth) == len(bevcli.open_sequence(STREET).load(0).ground_truth)


def test_a_drive_is_shown_with_measured_poses(folder, tmp_path, measuring):
    done = command(tmp_path, "viz", str(folder), "--odometry", "--frames", "0:2", "--out", "drive.rrd")
    assert done.returncode == 0, done.stderr
    assert "1/1 steps of the ego-motion" in done.stderr
    assert (tmp_path / "drive.rrd").exists()


@pytest.mark.slow
def test_a_validation_scores_drives_without_poses(folder, tmp_path, measuring):
    (tmp_path / "mini.toml").write_text(MINI_TOML)
    model = bevcli.load_model(tmp_path / "mini.toml", untrained=True)
    scores = bevcli.validate(model, data=folder, odometry=True)
    assert scores.to_dict()["frames"] == FRAMES
    assert [len(each.stamps) for each in measuring] == [FRAMES]  # once, although it is opened for several purposes


def test_boxes_are_scored_in_the_world_of_the_ground_truth():
    drive = bevcli.open_sequence(STREET, frames=slice(0, 2))
    moved, truth = [], []
    for place in range(2):
        frame = drive.load(place)
        pose, boxes = frame.world_from_ego, frame.ground_truth
        other = bevcli.Pose.from_matrix(inverse(drive.load(0).world_from_ego.matrix) @ pose.matrix)
        seen = replace(boxes, scores=np.ones(len(boxes)))
        truth.append(FrameBoxes(frame.stamp, pose, boxes))
        moved.append(FrameBoxes(frame.stamp, other, seen.transformed(other.matrix @ inverse(pose.matrix))))
    predicted = BoxesFile("world", tuple(moved), extras={"ego_motion": "measured"})
    pairs = pair_frames(predicted, BoxesFile("world", tuple(truth)))
    for found, true in zip(*pairs.boxes, strict=True):
        assert found.centers == pytest.approx(true.centers, abs=1e-6)


COMMAND_FRAMES = 5


@pytest.fixture
def measured_truly(monkeypatch):
    """A measurement that loads the frames of a drive, and gives the true motion."""
    true = motion_of(bevcli.open_sequence(STREET, frames=slice(0, COMMAND_FRAMES), ground_truth=False), guessed=(1,))

    def measured(drive, options=None):
        for index in range(len(drive.stamps)):
            drive.load(index)
        yield from true.steps

    monkeypatch.setattr(measure, "measure_steps", measured)


def test_a_drive_without_poses_gets_four_files_and_a_table(tmp_path, measured_truly):
    folder = street_copy(tmp_path / "drive", COMMAND_FRAMES)
    done = command(tmp_path, "odometry", str(folder))
    assert done.returncode == 0, done.stderr
    assert "4/4 steps" in done.stderr
    assert "m in 2.0 s, 4 steps" in done.stdout
    assert "not measured  1 step (too dark)" in done.stdout
    assert "stated poses" not in done.stdout
    out = tmp_path / "runs/drive-odometry"
    names = {"ego_motion.csv", "report.json", "odometry.png", "odometry.rrd"}
    assert {path.name for path in out.iterdir()} == names
    assert all(f"runs/drive-odometry/{name}" in done.stdout for name in names)
    assert bevcli.open_sequence(folder, ego_motion_file=out / "ego_motion.csv").has_ego_motion
    done = command(tmp_path, "odometry", str(STREET), "--out", str(STREET))
    assert done.returncode == 1
    assert "ego_motion.csv: is the input" in done.stderr


@pytest.mark.slow
def test_the_mistake_of_stated_poses_is_named(tmp_path, measured_truly):
    folder = street_copy(tmp_path / "drive", COMMAND_FRAMES)
    rows = [line.split(",") for line in (STREET / "ego_motion.csv").read_text().splitlines()]
    wrong = [[row[0], *(str(1000 * float(cell)) for cell in row[1:4]), *row[4:8]] for row in rows[1:]]
    (folder / "ego_motion.csv").write_text("\n".join(",".join(row) for row in [rows[0][:8], *wrong]))
    done = command(tmp_path, "odometry", str(folder), "--out", "out", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["stated"]["end_m"] > 1000
    assert ["millimetres" in finding["message"] for finding in report["stated"]["findings"]] == [True]
    assert report["not_measured"] == {"too dark": 1}
    assert report == json.loads((tmp_path / "out/report.json").read_text())


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
