"""The cheap checks before a run: one line for each error, which names the command that says more."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import MINI_TOML, command

from bevcli.findings import errors_of
from bevcli.rig.check_calibration import check_calibration
from bevcli.rig.sequence_checks import input_errors
from bevcli.sequences.open import open_sequence

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


def test_the_sample_and_the_first_frames_of_it_are_plausible():
    assert input_errors(open_sequence(SAMPLE)) == ()
    assert input_errors(open_sequence(SAMPLE, frames=slice(0, 1))) == ()


def test_a_camera_in_millimetres_is_one_line(spoilt):
    drive = spoilt(in_millimetres)
    (line,) = input_errors(open_sequence(drive), str(drive))
    assert "camera CAM_FRONT: the translation is in millimetres" in line
    assert line.endswith(f"`bevcli project-debug {drive}` says more")
    assert [finding.code for finding in errors_of(check_calibration(drive).findings)] == ["translation-unit"]


def test_ego_motion_in_millimetres_is_one_line_of_chosen_frames():
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
