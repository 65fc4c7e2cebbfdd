"""Stated poses against the measured motion: each planted mistake is named, and sound poses are not."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from memory_drive import MemoryDrive
from stated_mistakes import (
    DEVIATIONS,
    EVERY,
    FIRST,
    FRAMES,
    MISTAKES,
    POSITIONS,
    SHOWN,
    TIMES,
    YAWS,
    antenna,
    drive,
    jumping,
    measured,
    planar,
    stated,
    turned,
)

import bevcli
from bevcli.errors import Finding, InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.transforms import Pose
from bevcli.sequences.open import DriveView, select
from bevcli.workshop.calibration import calibrate
from bevcli.workshop.calibration.in_turn import check_motion as check
from bevcli.workshop.odometry import compare as comparing
from bevcli.workshop.odometry.compare import (
    chosen_frames,
    compare,
    stated_motion_findings,
    without_consequences,
)
from bevcli.workshop.odometry.measure import measure_motion

ROWS = np.arange(FIRST, FIRST + EVERY * FRAMES, EVERY)  # poses of the frames alone
SAMPLES = Path(__file__).parents[2] / "samples"
OFF = Finding("calibration-off", "warning", "CAM_FRONT", "does not fit how the vehicle moves")
UNSEEN = Finding("motion-not-measured", "info", None, "the drive does not show its calibration")
SCALE = Finding("motion-scale", "warning", None, "the poses have another scale than the images")
INFO = Finding("motion-not-compared", "info", None, "the poses were not compared with the images")


class MadeDrive(MemoryDrive):
    """The drive of stated_mistakes.py: nine frames, and their poses in a table or not."""

    def __init__(self, poses, in_table=True):
        super().__init__(count=0)
        times = SHOWN.timestamps_ns.tolist()
        self.stamps = tuple(FrameStamp(40 + place, "", time) for place, time in enumerate(times))
        self.poses, self.ego_motion = poses, poses if in_table else None

    def pose(self, place):
        row = FIRST + 25 * place
        return Pose(self.poses.translations[row], self.poses.quaternions[row])


@pytest.fixture
def shown(monkeypatch):
    def measure(drive):
        for place in range(len(drive.stamps)):
            drive.load(place)
        return iter(SHOWN.steps)

    monkeypatch.setattr(comparing, "measure_steps", measure)


@pytest.mark.parametrize("in_table", [True, False])
def test_a_wrong_drive_is_told_and_a_right_one_is_not(shown, in_table):
    assert stated_motion_findings(MadeDrive(stated(), in_table)) == ()
    (finding,) = stated_motion_findings(MadeDrive(MISTAKES["km/h"][0], in_table))
    assert finding.code == "motion-scale"


def test_wrong_poses_leave_out_the_calibration(shown, monkeypatch, capsys):
    monkeypatch.setattr(calibrate, "sound_steps", lambda drive: iter([False]))
    monkeypatch.setattr(calibrate, "motion_steps", lambda drive: iter([None, (OFF,)]))
    (finding,) = check(MadeDrive(MISTAKES["km/h"][0]))
    assert finding.code == "motion-scale"
    assert check(MadeDrive(stated())) == (OFF,)
    assert "steps of the check of poses and calibration" in capsys.readouterr().err


def test_what_fits_well_is_not_measured_any_further(monkeypatch, capsys):
    monkeypatch.setattr(calibrate, "sound_steps", lambda drive: iter([None, True]))
    monkeypatch.setattr(calibrate, "motion_steps", lambda drive: pytest.fail("measured all the same"))
    assert check(MadeDrive(stated())) == ()
    assert "the long check of them is left out" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sample", "scale", "cameras", "is_sound"),
    [
        ("street", 1.0, 6, True),
        ("street", 1.05, 6, False),
        ("street", 1.05, 4, False),
        ("street", 1.0, 4, True),  # of the last pair, 29 points of the road
        ("crossing", 1.0, 6, True),  # where two cameras are not measurable
    ],
)
def test_a_few_frames_tell_that_a_sample_drive_is_sound(sample, scale, cameras, is_sound):
    drive = bevcli.open_sequence(SAMPLES / sample, ground_truth=False)
    drive.ego_motion = replace(drive.ego_motion, translations=scale * drive.ego_motion.translations)
    rig = replace(drive.rig, cameras=drive.rig.cameras[:cameras])  # those to the front, and CAM_BACK
    assert calibrate.last(calibrate.sound_steps(DriveView(drive, chosen_frames(drive), rig=rig))) == is_sound


def test_one_cause_is_told_where_both_are_off():
    assert without_consequences((SCALE,), (OFF,), cameras=6) == (OFF,)
    assert without_consequences((SCALE,), (OFF,) * 4, cameras=6) == (SCALE,)
    assert without_consequences((SCALE,), (), cameras=6) == (SCALE,)
    assert without_consequences((), (OFF,), cameras=6) == (OFF,)
    assert without_consequences((INFO,), (UNSEEN,), cameras=6) == (UNSEEN,)
    assert without_consequences((INFO,), (OFF,), cameras=6) == (INFO, OFF)


def test_frames_are_chosen_where_the_poses_turn():
    drive = MadeDrive(stated())
    times = drive.ego_motion.timestamps_ns
    drive.stamps = tuple(FrameStamp(place, "", int(time)) for place, time in enumerate(times[::10]))  # 5 Hz
    places = chosen_frames(drive)
    assert len(places) == 9
    assert set(np.diff(places)) == {2}  # 0.4 s
    yaws = np.unwrap(2 * np.arctan2(drive.ego_motion.quaternions[:, 3], drive.ego_motion.quaternions[:, 0]))[::10]
    turns = [np.abs(np.diff(yaws[start : start + 17 : 2])).sum() for start in range(0, 132, 2)]
    assert np.abs(np.diff(yaws[places])).sum() > np.median(turns)


def test_a_short_drive_and_the_longest_scene_are_taken():
    assert chosen_frames(MemoryDrive(4)) == [0, 1, 2, 3]
    assert chosen_frames(MemoryDrive(6, scenes="aabbbb")) == [2, 3, 4, 5]
    assert chosen_frames(MemoryDrive(0)) == []


def test_what_cannot_be_measured_is_said(monkeypatch):
    def refuse(drive):
        raise InputError("memory: has one frame")

    monkeypatch.setattr(comparing, "measure_steps", refuse)
    (finding,) = stated_motion_findings(MemoryDrive(1))
    assert (finding.code, finding.severity) == ("motion-not-compared", "info")
    assert "memory: has one frame" in finding.message
    without = MemoryDrive(1)
    without.has_ego_motion = False
    assert stated_motion_findings(without) == ()


@pytest.fixture(scope="module")
def street():
    """The sample drive, and what its images show."""
    drive = bevcli.open_sequence(SAMPLES / "street", ground_truth=False)
    return drive, measure_motion(select(drive, chosen_frames(drive)))


@pytest.mark.slow
def test_the_poses_of_the_sample_drive_are_sound(street):
    drive, shown = street
    assert compare(drive.ego_motion, shown) == ()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "code", "found"),
    [
        (lambda motion: {"translations": 3.6 * motion.translations}, "motion-scale", r"^3\.[56]"),
        (lambda motion: {"translations": 1.08 * motion.translations}, "motion-scale", r"^1\.0[78]"),
        (lambda motion: {"timestamps_ns": motion.timestamps_ns + 200_000_000}, "motion-time", r"(19|20)\d ± \d+ ms"),
        (lambda motion: {"translations": 0 * motion.translations}, "motion-stands", "^0.0 m in the poses"),
    ],
)  # fmt: skip
def test_a_mistake_in_the_sample_drive_is_named(street, change, code, found):
    drive, shown = street
    (finding,) = compare(replace(drive.ego_motion, **change(drive.ego_motion)), shown)
    assert finding.code == code
    assert re.search(found, finding.found)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kitti-straight", "nuscenes-scene-0103"])
def test_the_poses_of_real_drives_are_sound(shared, name):
    drive = bevcli.open_sequence(shared / "data" / name, ground_truth=False)
    assert all(finding.severity == "info" for finding in stated_motion_findings(drive))


@pytest.mark.parametrize("name", MISTAKES)
def test_a_planted_mistake_is_the_only_finding(name):
    poses, code, message, found = MISTAKES[name]
    (finding,) = compare(poses, SHOWN)
    assert finding.code == code, finding
    assert message in finding.message
    assert found in finding.found
    assert finding.severity == ("warning" if name in ("wheel", "a little turned", "early", "antenna") else "error")


def test_frames_of_a_jump_have_the_given_numbers():
    (finding,) = compare(jumping(), SHOWN, range(40, 49))
    assert "between frames 43 and 44" in finding.found


@pytest.mark.parametrize("seed", range(4))
def test_sound_poses_have_no_finding(seed):
    times, positions, yaws = drive(seed=seed, turning=seed % 3, changing=seed % 2)
    noise = 0.01 * np.random.default_rng(seed).standard_normal(positions.shape)
    shown = measured(times, positions, yaws, seed)
    assert compare(planar(positions + noise, yaws, times), shown) == ()
    assert compare(planar(positions[ROWS], yaws[ROWS], times[ROWS]), shown) == ()


@pytest.mark.parametrize(
    ("poses", "number", "true"),
    [
        (stated(times_ns=TIMES + 180_000_000), r"are (\d+) ± (\d+) ms too late", 180),
        (stated(times_ns=TIMES + 5_000_000_000), r"are (\d+) ± (\d+) ms too late", 5000),
        (planar(*(each[ROWS] for each in (POSITIONS, YAWS, TIMES + 500_000_000))), r"are (\d+) ± (\d+) ms", 500),
        (stated(1.08 * POSITIONS), r"^(\d+.\d+) ± (\d+.\d+) times", 1.08),
        (turned(-6), r"points (\d+.\d+)° ± (\d+.\d+)° to the right", 6),
        (antenna((2.4, 0, 0)), r"^x \+(\d+.\d+) ± (\d+.\d+) m", 2.4),
    ],
)
def test_a_number_is_within_3_deviations(poses, number, true):
    (finding,) = compare(poses, SHOWN)
    value, deviation = map(float, re.search(number, finding.found).groups())
    assert abs(value - true) < 3 * deviation
    assert deviation < max(0.1 * true, 0.3)


def test_a_reading_that_fits_the_images_takes_the_place_of_other_findings(shown, monkeypatch):
    reading = Finding("motion-angles", "error", None, "the yaws of the poses are others")
    monkeypatch.setattr(comparing, "fitting_poses", lambda drive, poses: (reading, MISTAKES["km/h"][0]))
    findings = stated_motion_findings(MadeDrive(stated(3.6 * POSITIONS, np.pi / 2 - YAWS)))
    assert [finding.code for finding in findings] == ["motion-angles", "motion-scale"]


def test_images_that_stand_still_are_told():
    shown = measured(TIMES, 0 * POSITIONS, 0 * YAWS)
    (finding,) = compare(stated(), shown)
    assert (finding.code, finding.severity) == ("motion-stands", "error")
    assert "the images stand still" in finding.message
    assert compare(stated(0 * POSITIONS, 0 * YAWS), shown) == ()


def test_wide_deviations_are_no_comparison():
    wide = measured(TIMES, POSITIONS, YAWS, deviations=100 * DEVIATIONS)
    guessed = measured(TIMES, POSITIONS, YAWS, reason="too dark")
    for shown, text in ((wide, "0 steps could be measured"), (guessed, "0 steps could be measured: too dark")):
        (finding,) = compare(stated(3.6 * POSITIONS), shown)
        assert (finding.code, finding.severity) == ("motion-not-compared", "info")
        assert text in finding.message


def test_a_bad_measurement_of_one_step_is_no_jump():
    steps = list(SHOWN.steps)
    half = steps[3].ego_a_from_ego_b.copy()
    half[:3, 3] /= 2
    steps[3] = replace(steps[3], ego_a_from_ego_b=half)
    assert compare(stated(), replace(SHOWN, steps=tuple(steps))) == ()
