"""`bevcli odometry` as its user types it, with the true motion in place of the measurement."""

import json

import pytest
from command_line import command
from true_motion import STREET, motion_of, street_copy

import bevcli
from bevcli.workshop.odometry import measure

FRAMES = 3


@pytest.fixture
def measuring(monkeypatch):
    """A measurement that loads the frames of a drive, and gives the true motion."""
    true = motion_of(bevcli.open_sequence(STREET, frames=slice(0, FRAMES), ground_truth=False), guessed=(1,))

    def measured(drive, options=None, after_step=lambda: None):
        for place in range(len(drive.stamps)):
            drive.load(place)
        for _ in true.steps:
            after_step()
        return true

    monkeypatch.setattr(measure, "measure_motion", measured)


def test_a_drive_without_poses_gets_four_files_and_a_table(tmp_path, measuring):
    folder = street_copy(tmp_path / "drive", FRAMES)
    done = command(tmp_path, "odometry", str(folder))
    assert done.returncode == 0, done.stderr
    assert "2/2 steps" in done.stderr
    assert "m in 1.0 s, 2 steps" in done.stdout
    assert "not measured  1 step (too dark)" in done.stdout
    assert "stated poses" not in done.stdout
    out = tmp_path / "runs/drive-odometry"
    names = {"ego_motion.csv", "report.json", "odometry.png", "odometry.rrd"}
    assert {path.name for path in out.iterdir()} == names
    assert all(f"runs/drive-odometry/{name}" in done.stdout for name in names)
    assert bevcli.open_sequence(folder, ego_motion_file=out / "ego_motion.csv").has_ego_motion


def test_stated_poses_are_compared_and_json_is_printed(tmp_path, measuring):
    done = command(tmp_path, "odometry", str(STREET), "--frames", f"0:{FRAMES}", "--out", "out", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["stated"]["end_m"] == pytest.approx(0, abs=1e-6)
    assert report["not_measured"] == {"too dark": 1}
    assert report == json.loads((tmp_path / "out/report.json").read_text())


def test_the_drive_itself_is_no_output(tmp_path):
    done = command(tmp_path, "odometry", str(STREET), "--out", str(STREET))
    assert done.returncode == 1
    assert "ego_motion.csv: is the input" in done.stderr
