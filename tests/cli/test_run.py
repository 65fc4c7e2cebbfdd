"""`bevcli run` and `bevcli batch` as their user types them, with the mini model."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import MINI_TOML, command
from memory_drive import MemoryDrive, WithoutImages
from small_fleet import make_job, write_fleet

from bevcli.cli.run import _run_notes
from bevcli.errors import BevcliError, OutputError
from bevcli.frame import MAP_CLASSES
from bevcli.inference.load import Model
from bevcli.model.bevformer import BEVFormer
from bevcli.recording import RecordingOptions
from bevcli.runs.run_into_folder import RunOptions, run_into_folder
from bevcli.sequences.files.boxes_file import read_boxes
from bevcli.sequences.files.map_folder import open_maps
from bevcli.workshop.batch import Workers, worker
from bevcli.workshop.batch.worker import run_on_ray

SAMPLE = Path(__file__).parents[2] / "samples/street"


@pytest.fixture
def job(mini_model, tmp_path):
    """Runs a sequence in process; gives back the output folder."""

    def make(sequence, *, score=0.0, force=False, out="out", **options) -> Path:
        run_options = RunOptions(recording=RecordingOptions(score=score), save_bev=tmp_path / "bev", **options)
        run_into_folder(Model(mini_model), sequence, tmp_path / out, run_options, force=force)
        return tmp_path / out

    return make


def test_the_command_runs_the_sample_and_says_untrained(tmp_path):
    (tmp_path / "mini.toml").write_text(MINI_TOML)
    done = command(tmp_path, "run", str(SAMPLE), "--model", "mini.toml", "--untrained", "--frames", "0:2")
    assert done.returncode == 0, done.stderr
    out = tmp_path / "runs/street-mini"
    assert {path.name for path in out.iterdir()} == {
        "recording.rrd",
        "predictions.json",
        "summary.json",
        "calibration.json",
        "tracks.csv",
        ".bevcli",
    }
    assert json.loads((out / "calibration.json").read_text()) == json.loads((SAMPLE / "calibration.json").read_text())
    boxes = read_boxes(out / "predictions.json")
    assert [len(frame.boxes) for frame in boxes.frames] == [10, 10]
    assert boxes.extras["untrained"] is True
    assert json.loads((out / "summary.json").read_text())["untrained"] is True
    assert "UNTRAINED" in done.stdout
    assert "UNTRAINED" in done.stderr
    assert "2/2 frames" in done.stderr

    again = command(tmp_path, "run", str(SAMPLE), "--model", "mini.toml", "--untrained", "--frames", "0:1")
    assert again.returncode == 1
    assert "--force" in again.stderr
    assert len(read_boxes(out / "predictions.json").frames) == 2


@pytest.mark.slow
def test_one_thread_and_two_agree(job):
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = read_boxes(job(MemoryDrive(2), out="one") / "predictions.json")
        torch.set_num_threads(2)
        two = read_boxes(job(MemoryDrive(2), out="two") / "predictions.json")
    finally:
        torch.set_num_threads(threads)
    for a, b in zip(one.frames, two.frames, strict=True):
        assert a.boxes.centers == pytest.approx(b.boxes.centers, abs=1e-4)
        assert a.boxes.scores == pytest.approx(b.boxes.scores, abs=1e-4)


def test_bev_features_are_written_with_what_explains_them(job, tmp_path):
    job(MemoryDrive(2))
    features = np.load(tmp_path / "bev/000001.npy")
    facts = json.loads((tmp_path / "bev/000001.json").read_text())
    assert features.shape == (12, 10, 32)
    assert features.dtype == np.float16
    assert facts["untrained"] is True
    assert facts["frame"] == 1
    assert facts["x_range_m"] == [-25, 25]


def test_gaps_are_in_the_summary(job):
    out = job(WithoutImages({0: ["CAM_BACK"], 1: "all"}, count=3))
    summary = json.loads((out / "summary.json").read_text())
    assert summary["skipped_frames"] == [1]
    assert {"frame": 0, "camera": "CAM_BACK", "reason": "missing"} in summary["dropped_images"]
    frames = read_boxes(out / "predictions.json").frames
    assert frames[1].extras["skipped"] is True
    assert len(frames[1].boxes) == 0


def test_without_ego_motion_boxes_are_given_in_the_ego_frame(job):
    standing = MemoryDrive(1)
    standing.has_ego_motion = False
    assert read_boxes(job(standing) / "predictions.json").frame_of_reference == "ego"


def test_keyframes_of_nuscenes_also_go_into_a_submission(job):
    class WithTokens(MemoryDrive):
        def load(self, place):
            return replace(super().load(place), sample_token=f"token-{place}")

    submission = json.loads((job(WithTokens(2)) / "results_nusc.json").read_text())
    assert list(submission["results"]) == ["token-0", "token-1"]


def test_what_was_done_survives_a_failure_in_a_later_frame(job, tmp_path):
    class Failing(MemoryDrive):
        def load(self, place):
            if place == 2:
                raise OutputError("a failure")
            return super().load(place)

    with pytest.raises(OutputError, match="a failure"):
        job(Failing(4))
    assert len(read_boxes(tmp_path / "out/predictions.json").frames) == 2
    assert json.loads((tmp_path / "out/summary.json").read_text())["frames"] == 2


def test_a_missing_image_is_a_warning_and_with_strict_an_error(tmp_path):
    (tmp_path / "mini.toml").write_text(MINI_TOML)
    drive = tmp_path / "drive"
    shutil.copytree(SAMPLE, drive)
    with (drive / "frames.csv").open() as file:
        (drive / next(csv.DictReader(file))["CAM_BACK"]).unlink()
    arguments = ("run", "drive", "--model", "mini.toml", "--untrained", "--frames", "0:1", "--out", "out")
    lenient = command(tmp_path, *arguments)
    assert lenient.returncode == 0
    assert "warning: frame 0: camera CAM_BACK" in lenient.stderr
    strict = command(tmp_path, *arguments, "--force", "--strict")
    assert strict.returncode == 1
    assert "CAM_BACK" in strict.stderr.splitlines()[-1]


def test_the_note_on_rendered_streets_is_for_other_drives_only(mini_model):
    bundled = replace(Model(mini_model), bundled=True)
    drive = MemoryDrive(1)
    notes = "\n".join(_run_notes(bundled, drive, RunOptions()))
    assert "these weights were trained on rendered streets" in notes
    assert "`--model photographs` finds more" in notes
    drive.facts = replace(drive.facts, rendered=True)
    assert "trained on rendered streets" not in "\n".join(_run_notes(bundled, drive, RunOptions()))


def test_a_drive_far_above_the_rate_of_the_training_gets_a_note(mini_model):
    """The model's rate is 2 frames per second."""
    for step_s, temporal, is_noted in ((0.1, True, True), (0.1, False, False), (0.4, True, False)):
        notes = _run_notes(Model(mini_model), MemoryDrive(3, step_s=step_s), RunOptions(temporal=temporal))
        assert any("10 frames per second: the model learned its history at 2 " in note for note in notes) == is_noted


def run(config, out, frames, *, force=False):
    torch.manual_seed(0)
    options = RunOptions(recording=RecordingOptions("minimal"))
    run_into_folder(Model(BEVFormer(config).eval()), MemoryDrive(frames), out, options, force=force)


def test_maps_are_written_and_an_earlier_runs_maps_are_gone(mini_config, tmp_path):
    config = replace(mini_config, heads=("detection", "segmentation"))
    run(config, tmp_path, frames=3)
    run(config, tmp_path, frames=2, force=True)
    maps = open_maps(tmp_path / "segmentation")
    assert [maps.has(frame) for frame in range(3)] == [True, True, False]
    assert maps.load(1).cells.shape == (48, 40)
    assert (maps.x_range_m, maps.y_range_m, set(maps.classes)) == ((-25, 25), (-30, 30), set(MAP_CLASSES))


def test_a_model_without_the_head_writes_no_maps(mini_config, tmp_path):
    run(mini_config, tmp_path, frames=1)
    assert not (tmp_path / "segmentation").exists()


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("batch")
    (folder / "mini.toml").write_text(MINI_TOML)
    write_fleet(folder / "drives", 2, frames=1)
    return folder


@pytest.mark.slow
def test_the_commands_end_with_what_they_wrote(place):
    (place / "list.txt").write_text("drives/d001\ndrives/missing\n")
    arguments = ("batch", "drives/d000", "--list", "list.txt", "--out", "out", "--model", "mini.toml", "--untrained")
    done = command(place, *arguments, "--workers", "1", "--retries", "0")
    assert done.returncode == 3, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == "drives   2 of 3 done, 1 failed"
    assert [line.split()[-1] for line in lines if line.startswith("written")] == [
        str(place / "out" / name) for name in ("batch.parquet", "batch.csv", "report.html")
    ]
    assert f"failed: missing: {place}/drives/missing: is missing" in done.stderr
    assert "3/3 drives" in done.stderr


def test_mistakes_are_one_line(place):
    done = command(place, "batch", "drives/x*", "--out", "none", "--workers", "1")
    assert (done.returncode, done.stderr) == (1, "error: drives/x*: nothing matches this pattern (expected drives)\n")
    done = command(place, "batch", "drives/*", "--out", "none", "--model", "tiny", "--workers", "2")
    assert done.returncode == 1
    assert done.stderr.startswith("error: model tiny has no weights")
    assert not (place / "none").exists()


def test_a_cluster_needs_a_process_that_ran_no_local_batch(place, monkeypatch):
    monkeypatch.setattr(worker, "ray_is_installed", lambda: True)
    monkeypatch.setenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")  # what a batch on this machine leaves
    with pytest.raises(BevcliError, match="use a new process for `address`"):
        next(run_on_ray(make_job(place / "none", place / "mini.toml"), "hash", [], Workers(address="10.0.0.1:6379")))


def test_several_workers_without_ray_name_what_to_install(place, monkeypatch):
    monkeypatch.setattr(worker, "ray_is_installed", lambda: False)
    with pytest.raises(BevcliError, match=r"run pip install 'bevcli\[ray\]', or pass `count=1`"):
        next(run_on_ray(make_job(place / "none", place / "mini.toml"), "hash", [], Workers(2)))
