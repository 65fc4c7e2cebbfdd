"""The report of a measured motion: numbers, files that are read back, and the comparison with stated poses."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from true_motion import STREET, motion_of, street_copy

import bevcli
from bevcli.errors import InputError
from bevcli.findings import Finding
from bevcli.geometry.transforms import rigid, rotation_about_z
from bevcli.sequences.files.ego_motion_file import read_ego_motion
from bevcli.workshop.odometry.measure import MeasuredMotion, MeasuredStep
from bevcli.workshop.odometry.report import (
    against_stated,
    check_measured,
    end_deviations,
    measured_note,
    report_text,
    speeds,
    to_json,
    write_report,
    yaw_rates_deg,
)

DEVIATIONS = np.array([0.002, 0.001, 0.01, 0.03, 0.02, 0.01])


def curve(steps: int = 6, reason: str = "", step_s: float = 0.5) -> MeasuredMotion:
    """A vehicle that turns to the left: 2 m and 0.2 radians a step."""
    step = MeasuredStep(rigid((2, 0.1, 0), rotation_about_z(0.2)), np.diag(DEVIATIONS**2), reason)
    times = 10**9 + np.arange(steps + 1, dtype=np.int64) * int(step_s * 1e9)
    return MeasuredMotion("curve", times, (step,) * steps)


@pytest.fixture(scope="module")
def street():
    return bevcli.open_sequence(STREET, ground_truth=False, frames=slice(0, 6))


def test_the_deviation_of_the_end_is_that_of_many_drives():
    motion, random = curve(), np.random.default_rng(0)
    poses = np.tile(np.eye(4), (4000, 1, 1))
    shared = random.normal(scale=DEVIATIONS, size=(len(poses), 6))  # by the calibration
    for step in motion.steps:
        errors = (shared + random.normal(scale=DEVIATIONS, size=(len(poses), 6))) / np.sqrt(2)
        steps = np.tile(step.ego_a_from_ego_b, (len(poses), 1, 1))
        steps[:, :3, :3] = Rotation.from_rotvec(errors[:, :3]).as_matrix() @ steps[:, :3, :3]
        steps[:, :3, 3] += errors[:, 3:]
        poses = poses @ steps
    end = motion.poses[-1]
    apart = ((poses[:, :3, 3] - end[:3, 3]) ** 2).sum(-1)
    turned = Rotation.from_matrix(end[:3, :3].T @ poses[:, :3, :3]).magnitude()
    end_m, end_deg = end_deviations(motion)
    assert end_m == pytest.approx(np.sqrt(apart.mean()), rel=0.05)
    assert end_deg == pytest.approx(np.degrees(np.sqrt((turned**2).mean())), rel=0.05)


def test_speed_and_yaw_rate_are_those_of_the_step():
    speed, speed_deviation = speeds(curve())
    assert speed == pytest.approx(2 * np.hypot(2, 0.1))
    assert speed_deviation == pytest.approx(2 * 0.03, rel=0.01)
    rate, rate_deviation = yaw_rates_deg(curve())
    assert rate == pytest.approx(np.degrees(0.4))
    assert rate_deviation == pytest.approx(np.degrees(0.02))


def test_a_vehicle_that_drives_back_has_a_negative_speed():
    motion = curve(1)
    back = MeasuredMotion("back", motion.timestamps_ns, (MeasuredStep(rigid((-1, 0, 0)), np.eye(6)),))
    assert speeds(back)[0] == pytest.approx(-2)


def test_the_files_give_the_motion_back(street, tmp_path):
    motion = motion_of(street)
    write_report(motion, tmp_path / "out")
    read = read_ego_motion(tmp_path / "out/ego_motion.csv")
    for pose, time in zip(motion.poses, motion.timestamps_ns, strict=True):
        assert read.pose_at(int(time)).matrix == pytest.approx(pose, abs=1e-9)
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert len(report["steps"]) == len(motion.steps)
    assert report["steps"][2]["translation_deviation_m"] == pytest.approx([0.01] * 3)
    assert report["stated"] is None


def test_the_written_poses_are_those_of_the_drive(street, tmp_path):
    """Also at the times of the images, which are not those of the frames."""
    write_report(motion_of(street), tmp_path)
    copy = street_copy(tmp_path / "copy", 6)
    again = bevcli.open_sequence(copy, ego_motion_file=tmp_path / "ego_motion.csv", ground_truth=False)
    first = np.linalg.inv(street.load(0).world_from_ego.matrix)
    for place in range(len(street.stamps)):
        stated, written = street.load(place), again.load(place)
        assert written.world_from_ego.matrix == pytest.approx(first @ stated.world_from_ego.matrix, abs=1e-6)
        for name, pose in stated.world_from_ego_at.items():
            assert written.world_from_ego_at[name].matrix == pytest.approx(first @ pose.matrix, abs=0.02)


def test_a_scale_is_seen_against_stated_poses(street):
    poses = [street.load(place).world_from_ego.matrix for place in range(len(street.stamps))]
    difference = against_stated(motion_of(street, scale=1.02), poses)
    straight = np.linalg.norm(poses[-1][:3, 3] - poses[0][:3, 3])
    assert difference.end_m == pytest.approx(0.02 * straight, rel=0.01)
    assert difference.end_deg == pytest.approx(0, abs=1e-5)
    assert "(2.0 %)" in difference.text()
    wrong = Finding("speed", "error", None, "the wheel is small", advice="measure it")
    assert "error: the wheel is small: measure it" in report_text(motion_of(street), difference, [wrong])


def test_steps_that_are_guesses_are_counted_with_their_reasons(street):
    motion = motion_of(street, guessed=(1, 3))
    assert "not measured  2 steps (too dark)" in report_text(motion)
    assert measured_note(motion).endswith("in 5 steps; not measured: 2 steps (too dark)")
    assert json.loads(to_json(motion))["not_measured"] == {"too dark": 2}


def test_a_drive_without_a_measured_step_is_refused():
    check_measured(curve())
    with pytest.raises(InputError, match=r"curve: not one of 6 steps could be measured \(too dark\)"):
        check_measured(curve(reason="too dark"))


def test_one_frame_has_a_report_without_steps():
    still = MeasuredMotion("still", np.array([5], dtype=np.int64), ())
    assert "0.00 m in 0.0 s, 0 steps" in report_text(still)
    assert json.loads(to_json(still))["mean_speed_m_s"] is None
