"""`bevcli odometry` as its user types it, with the true motion in place of the measurement."""

import json

import pytest
from command_line import command
from true_motion import STREET, motion_of, street_copy

import bevcli
from bevcli.workshop.odometry import measure

FRAMES = 5


@pytest.fixture
def measuring(monkeypatch):
    """A measurement that loads the frames of a drive, and gives the true motion."""
    true = motion_of(bevcli.open_sequence(STREET, frames=slice(0, FRAMES), ground_truth=False), guessed=(1,))

    def measured(drive, options=None):
        for index in range(len(drive.stamps)):
            drive.load(index)
        yield from true.steps

    monkeypatch.setattr(measure, "measure_steps", measured)


def test_a_drive_without_poses_gets_four_files_and_a_table(tmp_path, measuring):
    folder = street_copy(tmp_path / "drive", FRAMES)
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


def test_the_mistake_of_stated_poses_is_named(tmp_path, measuring):
    folder = street_copy(tmp_path / "drive", FRAMES)
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


def test_the_drive_itself_is_no_output(tmp_path):
    done = command(tmp_path, "odometry", str(STREET), "--out", str(STREET))
    assert done.returncode == 1
    assert "ego_motion.csv: is the input" in done.stderr
