"""The whole way on the sample drive without its poses, with the measurement itself."""

import contextlib
import re

import pytest
from command_line import command
from interrupted import run_frames
from true_motion import STREET, motion_of, street_copy

import bevcli

FRAMES = 5
ROOT = STREET.parents[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return street_copy(tmp_path_factory.mktemp("street") / "drive", FRAMES)


@pytest.fixture(scope="module")
def true_poses():
    return motion_of(bevcli.open_sequence(STREET, frames=slice(0, FRAMES), ground_truth=False)).poses


@pytest.mark.slow
def test_the_written_poses_are_those_of_the_drive(folder, true_poses, tmp_path):
    done = command(tmp_path, "odometry", str(folder), "--out", "out")
    assert done.returncode == 0, done.stderr
    assert "not measured  no step" in done.stdout
    drive = bevcli.open_sequence(folder, ego_motion_file=tmp_path / "out/ego_motion.csv")
    for place, pose in enumerate(true_poses):
        assert drive.load(place).world_from_ego.translation == pytest.approx(pose[:3, 3], abs=0.05)


@pytest.mark.slow
def test_a_stopped_run_goes_on_to_the_same_boxes(folder, tmp_path):
    """The motion is measured again, with the same result to the bit."""
    model = bevcli.load_model("demo")
    drives = [bevcli.open_sequence(folder, odometry=True, frames=slice(0, 4)) for _ in range(2)]
    assert (drives[0].ego_motion.translations == drives[1].ego_motion.translations).all()
    bevcli.run_into_folder(model, drives[0], tmp_path / "whole")
    run_frames(2, model, drives[0], tmp_path / "cut")
    bevcli.run_into_folder(model, drives[1], tmp_path / "cut", resume=True)
    whole, cut = ((tmp_path / name / "predictions.json").read_bytes() for name in ("whole", "cut"))
    assert whole == cut


@pytest.mark.slow
def test_the_example_of_the_page_runs():
    [example] = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs/odometry.md").read_text(), re.MULTILINE | re.DOTALL)
    with contextlib.chdir(ROOT):
        exec(example, {})
