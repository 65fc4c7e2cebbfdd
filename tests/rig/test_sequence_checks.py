"""Planted mistakes of a calibration, ego motion, image times and coverage are found and nothing else; their codes."""

import ast
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import mistakes as made
import numpy as np
import pytest
from command_line import MINI_TOML, command
from healthy_rigs import HEALTHY, SIX, camera, copy_of, rig
from mistakes import MOTION_MISTAKES, drive, motion_of
from scipy.spatial.transform import Rotation
from stated_mistakes import MISTAKES

import bevcli
from bevcli.errors import errors_of
from bevcli.geometry.bev_grid import BevGrid
from bevcli.rig.check_calibration import check_calibration, check_camera_times, check_rig
from bevcli.rig.coverage import coverage_of
from bevcli.rig.drawings import horizon
from bevcli.rig.rig_checks import mounting_of, seen_fov_deg
from bevcli.rig.sequence_checks import check_ego_motion, input_errors
from bevcli.sequences.files.calibration_file import draft_calibration, read_calibration
from bevcli.sequences.files.ego_motion_file import read_ego_motion
from bevcli.sequences.open import open_sequence


@pytest.mark.parametrize("start_yaw", [0.0, 0.7, 2.0, -3.0])
@pytest.mark.parametrize("speed", [0.0, 3.0, 8.0, 35.0])
def test_a_healthy_drive_gives_no_finding(speed, start_yaw):
    assert check_ego_motion(drive(speed=speed, start_yaw=start_yaw)) == ()


@pytest.mark.parametrize("start_yaw", [2.0, *(pytest.param(yaw, marks=pytest.mark.slow) for yaw in (0.7, -2.5))])
@pytest.mark.parametrize("name", MOTION_MISTAKES)
def test_a_mistake_is_found_alone(name, start_yaw):
    code, spoil = MOTION_MISTAKES[name]
    assert [finding.code for finding in check_ego_motion(spoil(drive(start_yaw=start_yaw)))] == [code]


def test_parking_in_reverse_for_a_while_is_no_mistake():
    there, back = drive(seconds=15.0), drive(seconds=15.0)
    times = np.arange(len(there.timestamps_ns) * 5 // 4) / 20
    places = np.concatenate([there.translations, there.translations[: -len(there.translations) // 4 - 1 : -1]])
    quaternions = np.concatenate([there.quaternions, back.quaternions[: -len(there.translations) // 4 - 1 : -1]])
    count = min(len(times), len(places))
    assert check_ego_motion(motion_of(times[:count], places[:count], quaternions[:count])) == ()
    assert check_ego_motion(drive(seconds=0.05)) == ()  # one row


FRAMES = [10**18 + i * 500_000_000 for i in range(10)]


def late_by(milliseconds):
    return [time + milliseconds * 1_000_000 for time in FRAMES]


def test_cameras_within_hundredths_of_a_second_give_no_finding():
    assert check_camera_times(FRAMES, {"front": FRAMES, "back": late_by(-43), "left": late_by(40)}) == ()


@pytest.mark.parametrize(
    ("offset", "severity"), [(150, "warning"), (-200, "warning"), (700, "error"), (-3000, "error")]
)
def test_a_camera_that_is_late_or_early_is_named(offset, severity):
    (finding,) = check_camera_times(FRAMES, {"front": FRAMES, "back": late_by(offset)})
    assert (finding.code, finding.severity, finding.camera) == ("time-offset", severity, "back")
    assert f"{offset:+d} ms" in finding.found


def test_a_camera_with_jitter_or_without_images_is_named():
    wandering = [time + (i % 2) * 140_000_000 for i, time in enumerate(FRAMES)]
    (finding,) = check_camera_times(FRAMES, {"front": FRAMES, "back": wandering})
    assert (finding.severity, finding.camera) == ("warning", "back")
    (finding,) = check_camera_times(FRAMES, {"front": FRAMES, "back": [None] * len(FRAMES)})
    assert (finding.code, finding.camera) == ("camera-without-images", "back")


def test_velocities_from_uneven_poses_are_not_blamed(tmp_path):
    times = np.cumsum([0, *[10, 990] * 20]) * 1_000_000 + 10**18
    speeds = np.repeat([0.5, 30.0], 20)
    lines = ["timestamp_ns,x,y,z,qw,qx,qy,qz"]
    places = np.concatenate([[0], np.cumsum(speeds * np.diff(times) / 1e9)])
    lines += [f"{time},{x},0,0,1,0,0,0" for time, x in zip(times, places, strict=True)]
    path = tmp_path / "ego_motion.csv"
    path.write_text("\n".join(lines) + "\n")
    motion = read_ego_motion(path)
    assert not motion.velocities_are_stated
    assert "ego-speed" not in [finding.code for finding in check_ego_motion(motion)]
    path.write_text("\n".join([lines[0] + ",vx,vy,vz", *(line + ",1,0,0" for line in lines[1:])]) + "\n")
    assert "ego-speed" in [finding.code for finding in check_ego_motion(read_ego_motion(path))]


PACKAGE = Path(bevcli.__file__).parent
DOCUMENT = PACKAGE.parent / "docs" / "calibration.md"
CODE = r"[a-z]+(?:-[a-z]+)+"
DOCUMENTED = set(re.findall(f"`({CODE})`", DOCUMENT.read_text())) - {"project-debug"}
# docs/trust.md has those of faults in images.
FILES = [path for path in PACKAGE.rglob("*.py") if "trust" not in path.parts]
SOURCES = [ast.parse(text) for text in (path.read_text() for path in FILES) if "Finding" in text]
NODES = [node for source in SOURCES for node in ast.walk(source)]


def test_findings_in_the_code_and_in_the_document_are_the_same():
    calls = [node for node in NODES if isinstance(node, ast.Call) and ast.unparse(node.func) == "Finding"]
    codes = {call.args[0].value for call in calls if call.args and isinstance(call.args[0], ast.Constant)}
    assert len(codes) > 20
    assert sorted(codes - DOCUMENTED) == []
    texts = {node.value for node in NODES if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    of_motion = {code for _, code, *_ in MISTAKES.values()}  # made of their parts
    assert sorted(DOCUMENTED - texts - of_motion) == []
    for image in re.findall(r"\]\((images/[^)]+)\)", DOCUMENT.read_text()):
        assert (DOCUMENT.parent / image).stat().st_size > 10_000


def rig_of(document, folder):
    (folder / "calibration.json").write_text(json.dumps(document))
    return read_calibration(folder / "calibration.json")


def test_one_level_camera_sees_its_quadrant(tmp_path):
    """90° across at the bev frame's origin: far from the camera it sees |x| < y, and pillars as high as the camera."""
    document = rig(front=camera((0.94, 0.0, 1.84), 0, 800.0))
    document["cameras"]["front"]["intrinsics"][0][2] = 800.0
    grid = BevGrid(rows=40, columns=42)  # no cell lies on the diagonal
    coverage = coverage_of(rig_of(document, tmp_path), grid)
    x, y = np.moveaxis(grid.cell_centers(), -1, 0)
    far = y > 12  # nearer, the highest and lowest points leave the image, yet some of each pillar stays in it
    np.testing.assert_array_equal(coverage.counts[far], (np.abs(x) < y)[far].astype(int))
    assert (coverage.counts[y < 0] == 0).all()
    assert coverage.shares["front"] == coverage.counts.mean() == 1 - coverage.unseen
    one = camera((0.94, 0.0, 1.84), 0, 800.0)
    twice = coverage_of(rig_of(rig(a=one, b=one), tmp_path))
    assert set(np.unique(twice.counts)) == {0, 2}
    assert twice.overlap == twice.shares["a"]
    for name in ("four fisheyes", "seven"):
        assert all(share > 0.03 for share in coverage_of(rig_of(copy_of(name), tmp_path)).shares.values())


@pytest.mark.parametrize(
    ("yaw", "pitch", "roll"), [(0, 0, 0), (55, 3, -4), (-110, -20, 8), (180, 10, 0), (90, -45, 20), (0, 30, 180)]
)
def test_the_mounting_has_the_angles_the_camera_was_turned_by(yaw, pitch, roll, tmp_path):
    document = rig(any=camera((1.0, 0.5, 1.6), yaw, 900.0, pitch=pitch, roll=roll))
    mounting = mounting_of(rig_of(document, tmp_path)["any"].ego_from_camera)
    found = np.exp(1j * np.radians([mounting.yaw_deg, mounting.pitch_deg, mounting.roll_deg]))
    np.testing.assert_allclose(found, np.exp(1j * np.radians([yaw, pitch, roll])), atol=1e-12)
    assert mounting.height == 1.6


def test_the_field_of_view_of_a_pinhole(tmp_path):
    for focal, degrees in ((800.0, 90.0), (800.0 / np.tan(np.radians(15)), 30.0)):
        document = rig(any=camera((0, 0, 1.6), 0, focal))
        document["cameras"]["any"]["intrinsics"][0][2] = 800.0
        assert seen_fov_deg(rig_of(document, tmp_path)["any"])[0] == pytest.approx(degrees, abs=0.2)


def test_a_level_cameras_horizon_is_its_principal_points_row(tmp_path):
    level = rig_of(rig(any=camera((0, 0, 1.6), 30, 900.0)), tmp_path)["any"]
    rows = horizon(level)[:, 1]
    np.testing.assert_allclose(rows[np.isfinite(rows)], level.intrinsics[1, 2], atol=1e-6)
    up = rig_of(rig(any=camera((0, 0, 1.6), 30, 900.0, pitch=5)), tmp_path)["any"]
    lowest = np.nanmin(horizon(up)[:, 1])  # of a camera that looks up the horizon lies below the middle
    assert lowest == pytest.approx(up.intrinsics[1, 2] + 900 * np.tan(np.radians(5)), abs=1e-3)


SAMPLE = Path(__file__).parents[2] / "samples/street"


@pytest.fixture
def spoilt(tmp_path):
    """Makes a copy of the sample, two images a camera, whose calibration a function changes."""

    def make(change) -> Path:
        drive = tmp_path / "drive"
        ignore = shutil.ignore_patterns("ground_truth*")
        shutil.copytree(SAMPLE, drive, ignore=ignore)
        calibration = json.loads((drive / "calibration.json").read_text())
        change(calibration["cameras"])
        (drive / "calibration.json").write_text(json.dumps(calibration))
        return drive

    return make


def in_millimetres(cameras):
    pose = cameras["CAM_FRONT"]["ego_from_camera"]
    pose["translation"] = [1000 * metres for metres in pose["translation"]]


def test_a_camera_in_millimetres_is_one_line(spoilt):
    drive = spoilt(in_millimetres)
    (line,) = input_errors(open_sequence(drive), str(drive))
    assert "camera CAM_FRONT: the translation is in millimetres" in line
    assert line.endswith(f"`bevcli project-debug {drive}` says more")
    assert [finding.code for finding in errors_of(check_calibration(drive).findings)] == ["translation-unit"]


def test_ego_motion_in_millimetres_is_one_line_of_chosen_frames():
    assert input_errors(open_sequence(SAMPLE)) == input_errors(open_sequence(SAMPLE, frames=slice(0, 1))) == ()
    drive = open_sequence(SAMPLE, frames=slice(2, 12))
    motion = drive.ego_motion
    assert motion is not None
    drive.ego_motion = replace(motion, translations=1000 * motion.translations)
    (line,) = input_errors(drive)
    assert "wrong unit of timestamps or translations" in line


def test_the_command_names_the_error_before_the_run(spoilt, tmp_path):
    drive = spoilt(in_millimetres)
    (tmp_path / "mini.toml").write_text(MINI_TOML)
    done = command(tmp_path, "run", str(drive), "--model", "mini.toml", "--untrained", "--frames", "0:1")
    assert done.returncode == 0, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "millimetres" in line]
    assert "divide the translation by 1000" in line
    assert f"bevcli project-debug {drive}" in line
    assert f"bevcli project-debug {drive}" in done.stdout  # of the summary
    (note,) = json.loads((tmp_path / "runs/drive-mini/summary.json").read_text())["notes"][:1]
    assert "millimetres" in note


ALL = tuple(SIX["cameras"])
OTHERS = [name for name in ALL if name != "CAM_BACK"]


def report_of(document, folder):
    path = folder / "calibration.json"
    path.write_text(json.dumps(document))
    draft = draft_calibration(path)
    return check_rig(draft.rig, draft.findings)


def errors_in(document, folder):
    """The errors of a rig with a mistake. Beside errors its coverage is not reported, and is not computed here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bevcli.rig.check_calibration.coverage_of", lambda rig: None)
        return errors_of(report_of(document, folder).findings)


@pytest.mark.parametrize("name", HEALTHY)
def test_a_healthy_rig_gives_no_error(name, tmp_path):
    assert errors_of(report_of(copy_of(name), tmp_path).findings) == ()


OF_ONE_CAMERA = [*made.POSE_MISTAKES, ("rotation-twice", made.both_rotations)]
# A front camera's quaternion is nearly the same in either order, a back camera's is that of one upside down.
XYZW = [(name, "quaternion-order", made.xyzw) for name in ALL if name.endswith(("LEFT", "RIGHT"))]


@pytest.mark.parametrize(
    ("camera", "code", "mistake"),
    [
        *(("CAM_BACK", *each) for each in OF_ONE_CAMERA),
        *XYZW,
        ("CAM_FRONT_LEFT", "quaternion-norm", made.rounded),
        *(pytest.param(name, *each, marks=pytest.mark.slow) for name in OTHERS for each in OF_ONE_CAMERA),
    ],
)
def test_one_camera_with_a_mistake_is_named(code, mistake, camera, tmp_path):
    document = copy_of("six")
    mistake(document["cameras"][camera]["ego_from_camera"])
    errors = errors_in(document, tmp_path)
    assert [(error.code, error.camera) for error in errors] == [(code, camera)]


OF_OTHER_RIGS = [
    pytest.param(rig, *mistake, marks=[pytest.mark.slow] * (rig != "lorry"))
    for rig in ("lorry", "five", "seven", "numbered")
    for mistake in (*made.POSE_MISTAKES[:4], ("quaternion-order", made.xyzw))
]


@pytest.mark.parametrize(
    ("rig", "code", "mistake"),
    [*(("six", *each) for each in made.POSE_MISTAKES[:16]), ("six", "quaternion-order", made.xyzw), *OF_OTHER_RIGS],
)
def test_a_mistake_in_all_cameras_is_one_error(rig, code, mistake, tmp_path):
    document = copy_of(rig)
    for stated in document["cameras"].values():
        mistake(stated["ego_from_camera"])
    errors = errors_in(document, tmp_path)
    assert {error.code for error in errors} == {code}
    if rig == "six" and not code.startswith("rotation"):  # mistakes in the file itself are findings on each stated
        assert [error.camera for error in errors] == [None]
    if code == "translation-unit":  # consequences of an error are suppressed
        assert [finding.code for finding in report_of(document, tmp_path).findings] == [code]


@pytest.mark.parametrize(("code", "mistake"), [*made.LENS_MISTAKES, *made.FIELD_MISTAKES])
@pytest.mark.parametrize("camera", ["CAM_FRONT", pytest.param("CAM_BACK", marks=pytest.mark.slow)])
def test_one_camera_with_a_wrong_lens_is_named(code, mistake, camera, tmp_path):
    document = copy_of("six")
    mistake(document["cameras"][camera])
    errors = errors_in(document, tmp_path)
    assert [(error.code, error.camera) for error in errors] == [(code, camera)]


@pytest.mark.parametrize(("code", "mistake"), made.LENS_WARNINGS)
def test_an_unusual_lens_is_a_warning(code, mistake, tmp_path):
    document = copy_of("six")
    mistake(document["cameras"]["CAM_FRONT"])
    findings = report_of(document, tmp_path).findings
    assert (code, "warning", "CAM_FRONT") in {(found.code, found.severity, found.camera) for found in findings}


def test_the_message_names_the_image_size_of_the_intrinsics(tmp_path):
    document = copy_of("six")
    for stated in document["cameras"].values():
        made.scaled(0.5)(stated)
        stated["intrinsics"][0][2], stated["intrinsics"][1][2] = 400.0, 225.0
    (error,) = errors_in(document, tmp_path)
    assert error.camera is None
    assert "800 x 450" in error.message


@pytest.mark.parametrize(("a", "b"), [("FRONT_LEFT", "FRONT_RIGHT"), ("FRONT", "BACK"), ("FRONT_LEFT", "BACK_LEFT")])
def test_the_message_names_both_swapped_cameras(a, b, tmp_path):
    document = copy_of("six")
    cameras = document["cameras"]
    cameras[f"CAM_{a}"], cameras[f"CAM_{b}"] = cameras[f"CAM_{b}"], cameras[f"CAM_{a}"]
    (error,) = errors_in(document, tmp_path)
    assert error.code == "swapped-names"
    assert f"CAM_{a}" in error.message
    assert f"CAM_{b}" in error.message


def test_cameras_with_one_pose_or_one_against_its_name(tmp_path):
    document = copy_of("six")
    cameras = document["cameras"]
    cameras["CAM_BACK_LEFT"]["ego_from_camera"] = cameras["CAM_FRONT_LEFT"]["ego_from_camera"]
    (error,) = errors_in(document, tmp_path)
    assert (error.code, error.camera) == ("same-pose", "CAM_BACK_LEFT")
    assert "CAM_FRONT_LEFT" in error.message
    document = copy_of("one")
    document["cameras"] = {"front": document["cameras"]["dashcam"]}
    place, rotation = made.pose_of(document["cameras"]["front"]["ego_from_camera"])
    around = Rotation.from_euler("z", 180, degrees=True)
    made.set_pose(document["cameras"]["front"]["ego_from_camera"], place, around * rotation)
    (error,) = errors_in(document, tmp_path)
    assert (error.code, error.camera) == ("name-against-pose", "front")


def test_an_ego_frame_with_y_forward(tmp_path):
    document = copy_of("six")
    turn = Rotation.from_euler("z", 90, degrees=True)  # ego x right, y forward: what was ahead is at 90 degrees
    for stated in document["cameras"].values():
        place, rotation = made.pose_of(stated["ego_from_camera"])
        made.set_pose(stated["ego_from_camera"], turn.apply(place), turn * rotation)
    (error,) = errors_in(document, tmp_path)
    assert (error.code, error.camera) == ("ego-axes", None)


@pytest.mark.parametrize(("code", "mistake"), made.BEV_MISTAKES)
def test_a_wrong_bev_frame(code, mistake, tmp_path):
    document = copy_of("six")
    mistake(document["ego_from_bev"])
    errors = errors_in(document, tmp_path)
    assert [(error.code, error.camera) for error in errors] == [(code, None)]
    del document["ego_from_bev"]
    findings = report_of(document, tmp_path).findings
    assert [finding.severity for finding in findings if finding.code == "bev-assumed"] == ["info"]


def test_two_mistakes_in_two_cameras_are_both_found(tmp_path):
    document = copy_of("six")
    made.scaled(0.5)(document["cameras"]["CAM_BACK"])
    made.millimetres(document["cameras"]["CAM_FRONT_LEFT"]["ego_from_camera"])
    errors = errors_in(document, tmp_path)
    assert {(error.code, error.camera) for error in errors} == {
        ("intrinsics-resolution", "CAM_BACK"),
        ("translation-unit", "CAM_FRONT_LEFT"),
    }


def test_swapped_cameras_are_found_where_all_poses_are_inverted(tmp_path):
    document = copy_of("six")
    cameras = document["cameras"]
    for entry in cameras.values():
        made.inverted(entry["ego_from_camera"])
    front, back = cameras["CAM_FRONT"], cameras["CAM_BACK_LEFT"]
    front["ego_from_camera"], back["ego_from_camera"] = back["ego_from_camera"], front["ego_from_camera"]
    errors = errors_in(document, tmp_path)
    assert {error.code for error in errors} == {"transform-inverted", "swapped-names"}
    swapped = next(error for error in errors if error.code == "swapped-names")
    assert "CAM_FRONT and CAM_BACK_LEFT are swapped" in swapped.message
    assert swapped.advice.endswith("after correcting the poses")
    inverse = next(error for error in errors if error.code == "transform-inverted")
    assert all(name in inverse.message for name in cameras)
