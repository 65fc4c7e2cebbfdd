"""`calibrate`: planted errors are found, a right calibration stays, and what is not shown is said."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibration_accuracy import WrongTimes, errors_of_drive
from command_line import MINI_TOML, command, invoked
from memory_drive import MemoryDrive, make_camera
from planted import ThroughLens, angle_deg, distance_m, wrong_rig

import bevcli
from bevcli.errors import InputError, OutputError
from bevcli.geometry.cameras import Distortion
from bevcli.geometry.transforms import rigid, rotation_about_z
from bevcli.sequences.files.calibration_file import read_calibration, write_calibration
from bevcli.sequences.open import DriveView
from bevcli.workshop.calibration import CalibrateOptions, calibrate as calibrating, in_turn
from bevcli.workshop.calibration.calibrate import findings_of
from bevcli.workshop.calibration.estimates import Verdict, common_delay_text, either_text
from bevcli.workshop.odometry.measure import MeasuredStep

STREET = Path(__file__).parents[2] / "samples/street"
TURNED, LOW = "CAM_FRONT", "CAM_BACK"


def two_cameras(rig):
    return replace(rig, cameras=tuple(each for each in rig.cameras if each.name in (TURNED, LOW)))


@pytest.fixture(scope="module")
def street():
    """Eight frames of the street with two of its cameras, one turned by 2.3°, the other 15 cm too high."""
    drive = bevcli.open_sequence(STREET, frames=slice(5, 13), ground_truth=False)
    right = two_cameras(drive.rig)
    wrong = wrong_rig(right, TURNED, (1.0, -2.0, 0.5), (0, 0, 0))
    wrong = wrong_rig(wrong, LOW, (0, 0, 0), (0, 0, 0.15))
    return drive, right, wrong


@pytest.fixture(scope="module")
def result(street):
    return bevcli.calibrate(DriveView(street[0], rig=street[2]))


@pytest.mark.slow
def test_planted_errors_are_found_and_written(street, result, tmp_path):
    _, right, wrong = street
    assert angle_deg(right, wrong, TURNED) > 2
    assert angle_deg(right, result.rig, TURNED) < 0.3
    assert result[TURNED].rotation_deg[:2] == pytest.approx((2.0, 1.0), abs=0.3)  # turned to the left and up
    assert result[LOW].position_m[2] == pytest.approx(0.15, abs=0.03)
    assert result[LOW].verdict is Verdict.CORRECTED
    assert result[TURNED].before_px > 3 * result[TURNED].after_px
    assert result[TURNED].after_px < 1
    for name in (TURNED, LOW):
        wrong_by = wrong[name].ego_from_camera[:3, 3] - right[name].ego_from_camera[:3, 3]
        left = wrong_by - np.array(result[name].position_m)
        assert (np.abs(left) < 4 * np.array(result[name].position_deviation_m)).all()
    result.write(tmp_path)
    reread = read_calibration(tmp_path / "calibration.json")
    assert reread.names == (TURNED, LOW)
    assert angle_deg(reread, result.rig, TURNED) < 1e-6
    assert distance_m(reread, result.rig, LOW) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lens", "zoom"),
    [
        (Distortion("brown_conrady", (0.12, -0.05, 0.001, -0.001, 0.0)), 1.0),
        (Distortion("kannala_brandt", (0.02, -0.01, 0.0, 0.0)), 1.2),
    ],
)
def test_lens_distortion_is_respected(street, lens, zoom):
    _, right, wrong = street
    drive = bevcli.open_sequence(STREET, frames=slice(5, 17), ground_truth=False)
    seen = ThroughLens(DriveView(drive, rig=right), lens, zoom)
    poses = {each.name: each.ego_from_camera for each in wrong.cameras}
    stated = tuple(replace(each, ego_from_camera=poses[each.name]) for each in seen.rig.cameras)
    found = bevcli.calibrate(DriveView(seen, rig=replace(seen.rig, cameras=stated)))
    assert angle_deg(right, found.rig, TURNED) < 0.3
    assert found[LOW].position_m[2] == pytest.approx(0.15, abs=0.03)


@pytest.mark.slow
def test_a_right_calibration_is_not_changed():
    drive = bevcli.open_sequence(STREET)
    found = bevcli.calibrate(drive)
    assert [each.verdict for each in found.cameras] == [Verdict.FINE] * 6
    assert all(distance_m(drive.rig, found.rig, name) == 0 for name in drive.rig.names)


class WithoutMotion(MemoryDrive):
    """A drive of nine frames without poses."""

    has_ego_motion = False


class Standing(MemoryDrive):
    """A vehicle that stands."""

    def pose(self, place):
        return super().pose(0)


class Black(MemoryDrive):
    """A drive with black images."""

    def load(self, place):
        frame = super().load(place)
        black = {name: replace(i, pixels_bgr=np.zeros_like(i.pixels_bgr)) for name, i in frame.images.items()}
        return replace(frame, images=black)


@pytest.mark.parametrize(
    ("drive", "message"),
    [
        (MemoryDrive(count=1), "has one frame"),
        (WithoutMotion(count=9), "has no ego-motion"),
        (Standing(count=9), "moves between 0 pairs"),
        (MemoryDrive(count=4), "moves between 3 pairs"),
        (MemoryDrive(count=9, scenes="aaaabbbbb"), "has 2 scenes"),
        (Black(count=9), "no image shows anything"),
    ],
)
def test_a_drive_that_cannot_show_its_calibration_is_refused(drive, message):
    with pytest.raises(InputError, match=message):
        bevcli.calibrate(drive)


@pytest.mark.slow
def test_images_of_noise_are_refused():
    with pytest.raises(InputError, match="no points were found"):
        bevcli.calibrate(MemoryDrive(count=9))


@pytest.mark.slow
def test_the_command_writes_a_calibration(tmp_path):
    assert "CAM_FRONT_RIGHT" in invoked("calibrate", STREET, "--out", tmp_path / "rig").output
    assert {path.name for path in (tmp_path / "rig").iterdir()} == {"calibration.json", "report.json"}


def test_the_command_refuses_to_write_into_the_drive():
    with pytest.raises(OutputError, match="is the input"):
        invoked("calibrate", STREET, "--out", STREET)


def test_a_folder_without_ego_motion_is_refused(tmp_path):
    drive = tmp_path / "drive"
    drive.mkdir()
    for name in ("calibration.json", "frames.csv"):
        shutil.copy(STREET / name, drive)
    with pytest.raises(InputError, match="has no ego-motion"):
        invoked("calibrate", drive)


@pytest.mark.slow
def test_a_run_measures_first_and_says_what_it_corrects(tmp_path):
    right = bevcli.open_sequence(STREET).rig
    write_calibration(tmp_path / "wrong.json", wrong_rig(right, TURNED, (1, -2, 0), (0, 0, 0)))
    model = tmp_path / "mini.toml"
    model.write_text(MINI_TOML)
    done = command(
        tmp_path, "run", STREET, "--calibration", "wrong.json", "--calibrate", "--model", model, "--untrained",
        "--frames", "5:15", "--out", "run",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert f"calibration: {TURNED} is corrected: off by yaw +" in done.stderr


def undecided(estimate, *, correlation):
    """An estimate that is 50 ms late or turned to the left by one degree, as a vehicle that turns by 20° a second."""
    covariance = np.diag([1e-8, np.radians(0.5) ** 2, 1e-8, 1e-4, 1e-4, 1e-4, 0.06**2])
    covariance[1, 6] = covariance[6, 1] = correlation * np.sqrt(covariance[1, 1] * covariance[6, 6])
    change = np.array([0, -np.radians(0.5), 0, 0, 0, 0, 0.06 * 0.99])
    return replace(estimate, verdict=Verdict.CORRECTED, change=change, covariance=covariance, delay_deviation_ms=60.0)


@pytest.mark.slow
def test_a_time_offset_or_a_rotation_is_one_of_both(result):
    text = either_text(undecided(result[TURNED], correlation=0.99))
    assert text.startswith(f"the images of {TURNED} were taken 119 ms later than stated, or it is turned by 1.0°")
    assert either_text(undecided(result[TURNED], correlation=0.1)) == ""


def turned_by(rig, yaw_deg):
    return wrong_rig(rig, TURNED, (0, yaw_deg, 0), (0, 0, 0))


@pytest.mark.slow
def test_motion_and_calibration_are_measured_until_both_stand(result, street, monkeypatch):
    """Each round leaves half of the error of the rig that the motion was measured with."""
    left_deg = [0.12]

    def measured(drive):
        assert angle_deg(street[1], drive.rig, TURNED) == pytest.approx(left_deg[-1], abs=1e-3)
        yield from [MeasuredStep(rigid((2, 0, 0)), np.eye(6))] * (len(drive.stamps) - 1)

    def halved(drive, options):
        assert angle_deg(street[1], drive.rig, TURNED) == pytest.approx(0.12, abs=1e-3)  # as stated, in every round
        left_deg.append(left_deg[-1] / 2)
        yield replace(result, rig=turned_by(street[1], left_deg[-1]))

    monkeypatch.setattr(in_turn, "measure_steps", measured)
    monkeypatch.setattr(in_turn, "calibration_steps", halved)
    drive = DriveView(street[0], rig=turned_by(street[1], 0.12))
    *steps, found = in_turn.calibrate_in_turn(drive, CalibrateOptions())
    assert left_deg == [0.12, 0.06, 0.03, 0.015]  # the last change is less than 0.02°
    assert (found.rounds, len(steps) + 1) == (3, 3 * (in_turn.MOTION_STEPS + 1))
    assert found.whole.height_deviation_m == 0.2
    assert "heights count from their stated mean" in found.text()
    assert '"rounds": 3' in found.to_json()


def test_a_rig_that_is_turned_drives_beside_x():
    """On circles of all radii, with the ego frame ahead of the axle that does not slip."""
    pose, poses = np.eye(4), []
    turned = rigid((0.9, 0, 0), rotation_about_z(np.radians(-1.5)))
    for bend in (0.0, 0.02, -0.05, 0.04, 0.0, 0.01):
        poses.append(pose @ turned)
        angle = 2.0 * bend
        arc = (2.0, 0, 0) if not bend else (np.sin(angle) / bend, (1 - np.cos(angle)) / bend, 0)
        pose = pose @ rigid(arc, rotation_about_z(angle))
    beside, deviation = in_turn.beside_x_deg(np.stack([*poses, pose @ turned]))
    assert beside == pytest.approx(1.5, abs=0.02)
    assert deviation < 0.05
    assert in_turn.beside_x_deg(np.stack([np.eye(4)] * 9)) == (0.0, 180.0)


def delayed(estimate, delay_ms, deviation_ms=4.0):
    return replace(estimate, delay_ms=delay_ms, delay_deviation_ms=deviation_ms)


@pytest.mark.slow
def test_a_delay_of_all_cameras_may_be_one_of_the_poses(result):
    both = [delayed(result[TURNED], 17.0), delayed(result[LOW], 21.0)]
    text = common_delay_text(both, 103.7)
    assert text.startswith(
        "the images of all cameras were taken 19 ± 4 ms later than stated, or the poses are of times"
    )
    assert "or the frames, one each 103.7 ms as stated, were not taken evenly" in text
    assert "evenly" not in common_delay_text(both, None)
    [finding] = findings_of([replace(each, verdict=Verdict.FINE) for each in both])
    assert (finding.code, finding.camera) == ("capture-times-off", None)


@pytest.mark.slow
def test_a_delay_of_one_camera_is_not_one_of_the_poses(result):
    assert not common_delay_text([delayed(result[TURNED], 80.0), delayed(result[LOW], 1.0)], None)
    assert not common_delay_text([delayed(result[TURNED], 80.0), delayed(result[LOW], 0.0, 60.0)], None)
    assert not common_delay_text([delayed(result[TURNED], 4.0), delayed(result[LOW], 3.0)], None)


@pytest.mark.slow
def test_wrong_capture_times_are_found():
    drive = bevcli.open_sequence(STREET, ground_truth=False)
    found = bevcli.calibrate(WrongTimes(drive, TURNED, late_ms=100))
    assert found[TURNED].delay_ms == pytest.approx(-100, abs=15)
    assert angle_deg(drive.rig, found.rig, TURNED) < 0.3


@pytest.mark.slow
def test_a_camera_that_sees_a_pavement_finds_the_road(tmp_path):
    bevcli.render(tmp_path / "d", seed=1000100, rig=STREET.parents[1] / "docs/rigs/four-100.json")
    drive = bevcli.open_sequence(tmp_path / "d", ground_truth=False)
    errors = {each.camera: each for each in errors_of_drive(drive, [4], [0])}
    assert abs(errors["right"].height_m) < 0.03  # the pavement to its right is 15 cm higher
    assert errors["right"].rotation_deg < 0.2


@pytest.mark.parametrize(
    ("matches", "deviation_deg", "said"),
    [
        (25, 0.1, "25 matches; its images are 160 x 90: about 320 x 180 would do"),
        (500, 0.9, "the drive shows its rotation to ±0.9° only; its images are 160 x 90: about 480 x 270 would do"),
        (0, 0.9, "0 matches; its images are 160 x 90: about 1000 x 562 would do"),
        (
            500,
            3.0,
            "the drive shows its rotation to ±3.0° only; its images are 160 x 90: "
            "1000 x 562 would show about ±0.5°, and a longer drive less",
        ),
    ],
)
def test_small_images_name_the_size_that_would_do(matches, deviation_deg, said):
    camera = make_camera("CAM_FRONT", 0.0, 160, 90)
    assert calibrating._reason(matches, 8, np.array([deviation_deg, 0.1, 0.1]), camera) == said
    large = make_camera("CAM_FRONT", 0.0, 1600, 900)
    assert "would do" not in calibrating._reason(matches, 8, np.array([deviation_deg, 0.1, 0.1]), large)


def test_a_rotation_about_the_way_asks_for_a_turn():
    """Larger images do not show it: points that move along the way look the same from a camera that is rolled."""
    camera = make_camera("CAM_FRONT", 0.0, 160, 90)
    rolled, pitched = np.array([0.1, 0.1, 0.9]), np.array([0.9, 0.1, 0.1])
    asked = "the road shows too little, and the vehicle turns too little; a turn at a junction would do"
    assert calibrating._reason(500, 8, rolled, camera, 2.0) == f"the drive shows its rotation to ±0.9° only: {asked}"
    assert "junction" not in calibrating._reason(500, 8, rolled, camera, 40.0)
    assert "junction" not in calibrating._reason(500, 8, pitched, camera, 2.0)
    beside = make_camera("CAM_LEFT", 90.0, 160, 90)  # its right axis points along the way
    assert "junction" in calibrating._reason(500, 8, pitched, beside, 2.0)
