"""The command and its library function: exit codes, JSON, images, and findings about a sequence."""

import json
import shutil

import cv2
import numpy as np
import pytest
from command_line import invoked
from healthy_rigs import HEALTHY, copy_of
from recorded_drive import screenshot_or_skip

from bevcli.errors import InputError
from bevcli.rig import drawings
from bevcli.rig.check_calibration import check_calibration

FAST_RIGS = ("four fisheyes",)  # other tests write the files of rigs with plain lenses
FILES = {"cameras.png", "coverage.png", "recording.rrd", "findings.json"}


def test_one_camera_is_drawn_large_with_a_fine_grid(tmp_path):
    """Six images are 520 pixels wide; one has the width of three of them."""
    document = copy_of("six")
    document["cameras"] = {"CAM_FRONT": document["cameras"]["CAM_FRONT"]}
    check = check_calibration(calibration(document, tmp_path))
    white = {"CAM_FRONT": np.full((900, 1600, 3), 255, np.uint8)}
    drawings.write_camera_sheet(tmp_path / "one.png", check.rig, (), check.coverage, white)
    sheet = cv2.imread(str(tmp_path / "one.png"))
    assert ((sheet > 200).all(-1).mean(1) > 0.7).sum() > 300  # rows of pixels, most of them of the image
    camera = check.rig.cameras[0]
    assert len(drawings.ground_lines(camera, 1.0, 15.0)) > 1.5 * len(drawings.ground_lines(camera))


def run(*arguments, code=0):
    return invoked("project-debug", *arguments, code=code)


def calibration(document, folder):
    path = folder / "calibration.json"
    path.write_text(json.dumps(document))
    return path


@pytest.fixture
def undrawn(monkeypatch):
    """A function: from then on both PNG files are empty. Drawing them takes most of the time of a command."""

    def leave_out():
        for name in ("write_camera_sheet", "write_coverage_map"):
            monkeypatch.setattr(drawings, name, lambda path, *content: path.touch())

    return leave_out


@pytest.mark.parametrize(("facts", "model"), [({}, "photographs"), ({"rendered": True}, "demo")])
def test_the_rig_is_compared_with_those_of_the_model_that_would_run(tmp_path, undrawn, facts, model):
    document = copy_of("six") | facts
    document["cameras"] = {"CAM_FRONT": document["cameras"]["CAM_FRONT"]}
    undrawn()
    done = run(calibration(document, tmp_path), "--out", tmp_path / "out")
    assert f"\nModel {model}: the rig is unlike " in done.stdout


@pytest.fixture
def small_drive(tmp_path):
    return write_drive(tmp_path / "drive")


def write_drive(folder):
    """Five frames of two cameras, driving straight ahead at 10 m/s."""
    document = copy_of("six")
    document["cameras"] = {name: document["cameras"][name] for name in ("CAM_FRONT", "CAM_BACK")}
    for name, camera in document["cameras"].items():
        camera["width"], camera["height"] = 160, 90
        camera["intrinsics"] = [[value / 10 for value in row] for row in camera["intrinsics"][:2]] + [[0, 0, 1]]
        (folder / "images" / name).mkdir(parents=True)
        for number in range(5):
            cv2.imwrite(str(folder / "images" / name / f"{number}.png"), np.full((90, 160, 3), 40 * number, np.uint8))
    calibration(document, folder)
    rows = ["frame,timestamp_ns,CAM_FRONT,CAM_BACK,CAM_BACK.timestamp_ns"]
    for number in range(5):
        time = 10**9 + number * 500_000_000
        rows.append(f"{number},{time},images/CAM_FRONT/{number}.png,images/CAM_BACK/{number}.png,{time + 20_000_000}")
    (folder / "frames.csv").write_text("\n".join(rows))
    write_motion(folder, heading=(1, 0, 0, 0))
    return folder


def write_motion(folder, heading, rows=31):
    """Ego-motion with 10 poses a second, from 0.1 s before the first frame; 31 rows cover all frames."""
    times = range(10**9 - 10**8, 4 * 10**9, 10**8)[:rows]
    lines = [f"{t},{t / 1e8},0,0,{','.join(map(str, heading))}" for t in times]
    (folder / "ego_motion.csv").write_text("\n".join(["timestamp_ns,x,y,z,qw,qx,qy,qz", *lines]))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in FAST_RIGS)) for name in HEALTHY]
)
def test_every_healthy_rig_gets_all_files_and_exit_code_0(name, tmp_path):
    result = run(calibration(copy_of(name), tmp_path), "--out", tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES
    for image in ("cameras.png", "coverage.png"):
        assert cv2.imread(str(tmp_path / "out" / image)).std() > 10
    assert max(map(len, result.stdout.splitlines()[:-1])) <= 110


def test_an_error_is_exit_code_3_and_one_json_object(tmp_path, undrawn):
    undrawn()
    document = copy_of("six")
    for camera in document["cameras"].values():
        camera["ego_from_camera"]["translation"] = [1000 * v for v in camera["ego_from_camera"]["translation"]]
    result = run(calibration(document, tmp_path), "--out", tmp_path / "out", "--json", code=3)
    report = json.loads(result.stdout)
    assert set(report) == {"findings", "coverage"}
    (finding,) = report["findings"]
    assert set(finding) == {"code", "severity", "camera", "message", "found", "expected", "advice"}
    assert (finding["code"], finding["severity"], finding["camera"]) == ("translation-unit", "error", None)
    assert report == json.loads((tmp_path / "out" / "findings.json").read_text())
    assert sum(report["coverage"]["cells_by_cameras"].values()) == 10_000


@pytest.mark.slow
def test_what_run_refuses_is_explained(tmp_path):
    document = copy_of("six")
    del document["cameras"]["CAM_BACK"]["intrinsics"]
    document["cameras"]["CAM_FRONT"]["ego_from_camera"]["rotation_wxyz"] = [0.5, -0.5, 0.5, -0.4]
    result = run(calibration(document, tmp_path), "--out", tmp_path / "out", "--json", code=3)
    found = {(f["code"], f["camera"]) for f in json.loads(result.stdout)["findings"] if f["severity"] == "error"}
    assert found == {("missing-key", "CAM_BACK"), ("quaternion-norm", "CAM_FRONT")}
    assert (tmp_path / "out" / "cameras.png").exists()


def test_a_calibration_without_usable_cameras_gets_its_findings(tmp_path):
    path = calibration({"format": "bevcli-calibration/1", "cameras": {"front": {}}}, tmp_path)
    result = run(path, "--out", tmp_path / "out", code=3)
    assert "missing-key" in result.stdout
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"findings.json"}
    path.write_text("{")  # no JSON at all is a mistake in the input
    with pytest.raises(InputError):
        run(path, "--out", tmp_path / "out")


def test_a_healthy_sequence(small_drive, tmp_path, undrawn):
    undrawn()
    result = run(small_drive, "--out", tmp_path / "out", "--json")
    codes = {finding["code"] for finding in json.loads(result.stdout)["findings"]}
    assert codes <= {"cells-unseen", "overlap-far", "motion-not-measured"}
    with pytest.raises(InputError, match="5 frames"):
        run(small_drive, "--frame", 5, "--out", tmp_path / "out")


@pytest.mark.slow
def test_a_calibration_with_another_folder_s_images(small_drive, tmp_path):
    path = tmp_path / "mine.json"
    shutil.move(small_drive / "calibration.json", path)
    result = run(path, "--sequence", small_drive, "--frame", 2, "--out", tmp_path / "out")
    assert "drive: 2 cameras" in result.stdout


def test_images_of_another_size_are_explained(small_drive):
    document = json.loads((small_drive / "calibration.json").read_text())
    for camera in document["cameras"].values():
        camera["width"], camera["height"] = 320, 180
        camera["intrinsics"] = [[2 * value for value in row] for row in camera["intrinsics"][:2]] + [[0, 0, 1]]
    calibration(document, small_drive)
    (error,) = check_calibration(small_drive).errors
    assert error.code == "sequence-refused"
    assert "160" in error.message


def test_ego_motion_that_misses_frames_is_explained_with_images(small_drive):
    write_motion(small_drive, heading=(1, 0, 0, 0), rows=5)
    check = check_calibration(small_drive)
    (error,) = check.errors
    assert error.code == "sequence-refused"
    assert "ego_motion.csv" in error.message
    assert check.images.keys() == {"CAM_FRONT", "CAM_BACK"}


@pytest.mark.slow
def test_the_real_sequences_give_no_error(shared, tmp_path):
    for name in ("nuscenes-scene-0103", "nuscenes-mini-4"):
        result = run(shared / "data" / name, "--out", tmp_path / name, "--json")
        assert result.exit_code == 0
        assert [f["code"] for f in json.loads(result.stdout)["findings"] if f["severity"] != "info"] == []


@pytest.mark.slow
def test_the_viewer_shows_all_views_of_the_recording(small_drive, tmp_path):
    run(small_drive, "--out", tmp_path / "out")
    views = screenshot_or_skip(tmp_path / "out" / "recording.rrd", tmp_path / "shot.png")
    assert set(views) == {"The rig", "Cameras per BEV cell", "Findings", "CAM_FRONT", "CAM_BACK"}
    assert cv2.imread(str(tmp_path / "shot.png")).std() > 10


@pytest.mark.slow
def test_the_command_prints_what_the_library_returns(small_drive, tmp_path, undrawn):
    write_motion(small_drive, heading=(0.5**0.5, 0, 0, 0.5**0.5))
    check = check_calibration(str(small_drive), frame=3)
    assert [error.code for error in check.errors] == ["ego-sideways"]
    assert (check.images["CAM_BACK"] == 120).all()  # frame 3
    assert {path.name for path in check.write(tmp_path / "here")} == FILES
    undrawn()
    printed = run(small_drive, "--frame", 3, "--out", tmp_path / "out", "--json", code=3)
    assert printed.stdout == check.to_json() + "\n" == (tmp_path / "here" / "findings.json").read_text()
    assert run(small_drive, "--frame", 3, "--out", tmp_path / "out", code=3).stdout.startswith(check.text())
