"""Interrupted runs: resumed they equal uninterrupted ones, and the output folder keeps what is not theirs."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from memory_drive import MemorySequence

from bevcli.errors import OutputError
from bevcli.frame import FrameStamp
from bevcli.model.bevformer import BEVFormer
from bevcli.pipeline import run_state
from bevcli.pipeline.model_loading import Model
from bevcli.pipeline.run import RunOptions, run_into_folder
from bevcli.pipeline.tracking import TrackerConfig
from bevcli.recording.options import RecordingOptions
from bevcli.sequences.files.boxes_file import read_boxes
from bevcli.viewer.recording_file import open_recording
from bevcli.viewer.recording_reader import RecordingReader

FRAMES = 6


class Drive(MemorySequence):
    """A drive with the tokens of nuScenes keyframes; loading the frame `broken` fails."""

    broken = FRAMES

    def __init__(self, count=FRAMES, **options):
        super().__init__(count, **options)

    def load(self, place):
        if place == self.broken:
            raise KeyboardInterrupt
        return replace(super().load(place), sample_token=f"token-{place}")


@pytest.fixture(scope="module")
def model(mini_config):
    torch.manual_seed(1)
    config = replace(mini_config, heads=("detection", "segmentation"))
    return Model(BEVFormer(config).eval(), tracker=TrackerConfig(birth_score=0.0, keep_score=0.0))


def run_all(model, out, sequence=None, score=0.0, **arguments):
    options = RunOptions(recording=RecordingOptions(score=score), save_bev=out.parent / f"{out.name}-bev")
    return run_into_folder(model, Drive() if sequence is None else sequence, out, options, **arguments)


def contents(out: Path) -> dict[str, bytes]:
    """The files whose bytes do not depend on the time that a run took."""
    folders = (out, out.parent / f"{out.name}-bev")
    files = [path for folder in folders for path in folder.rglob("*") if path.is_file() and ".bevcli" not in path.parts]
    return {path.name: path.read_bytes() for path in files if path.name not in ("recording.rrd", "summary.json")}


@pytest.fixture(scope="module")
def whole(model, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "out"
    run_all(model, out)
    return out


def assert_equals(out: Path, whole: Path) -> None:
    assert contents(out) == contents(whole)
    with open_recording(out / "recording.rrd") as file:
        assert not file.repaired
        assert [frame.index for frame in RecordingReader(file.path).frames()] == list(range(FRAMES))
    one, other = (json.loads((folder / "summary.json").read_text()) for folder in (out, whole))
    for key in ("frames", "boxes", "boxes_by_class", "tracks", "started_anew", "dropped_pictures"):
        assert one[key] == other[key]


@pytest.mark.parametrize("finished", range(FRAMES + 1))
def test_a_resumed_run_equals_an_uninterrupted_one(model, whole, tmp_path, finished):
    drive = Drive()
    drive.broken = finished
    out = tmp_path / "out"
    if finished < FRAMES:
        with pytest.raises(KeyboardInterrupt):
            run_all(model, out, drive)
    else:
        run_all(model, out, drive)
    assert len(read_boxes(out / "predictions.json").frames) == finished
    run_all(model, out, resume=True)
    assert_equals(out, whole)


def test_a_run_may_be_interrupted_after_every_frame(model, whole, tmp_path):
    out, resumed = tmp_path / "out", []
    run_all(model, out, should_stop=iter([False, True]).__next__)
    for _ in range(FRAMES):
        run_all(model, out, resume=True, should_stop=lambda: True, resumed=resumed.append)
    assert resumed == [2, 3, 4, 5, 6, 6]
    assert_equals(out, whole)


def test_a_killed_run_goes_on_from_its_last_saved_state(model, whole, tmp_path, monkeypatch):
    monkeypatch.setattr(run_state, "SHARE", 1.0)
    monkeypatch.setattr(run_state, "ASSUMED_S", 0.0)
    out, copy = tmp_path / "out", tmp_path / "copy"

    def copy_at_four(frame, prediction):
        if frame.stamp.index == 3:  # what a kill here leaves
            shutil.copytree(out, copy)

    run_all(model, out, after_frame=copy_at_four)
    assert (copy / "predictions.json.partial").exists()
    assert not (copy / "predictions.json").exists()
    assert len(read_boxes(copy / "predictions.json").frames) == 4
    resumed = []
    (tmp_path / "out-bev").rename(tmp_path / "copy-bev")
    shutil.rmtree(out)
    copy.rename(out)
    (tmp_path / "copy-bev").rename(tmp_path / "out-bev")
    run_all(model, out, resume=True, resumed=resumed.append)
    assert 2 <= resumed[0] <= 4
    assert_equals(out, whole)


@pytest.fixture
def interrupted(model, tmp_path):
    run_all(model, tmp_path / "out", should_stop=iter([False, False, True]).__next__)
    return tmp_path / "out"


def test_another_run_cannot_be_resumed_and_the_difference_is_named(model, mini_model, interrupted):
    before = contents(interrupted)
    shifted = Drive()
    shifted.stamps = (FrameStamp(0, "b", 5), *shifted.stamps[1:])
    with pytest.raises(OutputError, match=r"frames of the input: was 6, \w+, is 6, \w+"):
        run_all(model, interrupted, shifted, resume=True)
    with pytest.raises(OutputError, match=r"option recording: was .*0.0.*is .*0.5") as error:
        run_all(model, interrupted, score=0.5, resume=True)
    assert "\n" not in str(error.value)
    with pytest.raises(OutputError, match=r"model: was .* weights: was"):
        run_all(Model(mini_model), interrupted, resume=True)
    with pytest.raises(OutputError, match="exclude each other"):
        run_all(model, interrupted, resume=True, force=True)
    assert contents(interrupted) == before


def test_an_interrupted_run_is_not_overwritten_without_being_told(model, interrupted):
    with pytest.raises(OutputError, match="--resume"):
        run_all(model, interrupted)


def test_a_broken_state_is_an_error_of_one_line(model, interrupted):
    (interrupted / ".bevcli/state.safetensors").write_bytes(b"no state")
    with pytest.raises(OutputError, match="--force to start anew") as error:
        run_all(model, interrupted, resume=True)
    assert "\n" not in str(error.value)


def test_resume_without_an_earlier_run_starts_at_the_first_frame(model, whole, tmp_path):
    run_all(model, tmp_path / "out", resume=True)
    assert_equals(tmp_path / "out", whole)


def test_force_removes_only_what_a_run_wrote(model, tmp_path):
    out = tmp_path / "out"
    run_all(model, out)
    kept = [out / "segmentation/0001.png", out / "segmentation/000099.png", out / "notes.txt", tmp_path / "a.json"]
    for path in kept:
        path.write_text("mine")
    (out / ".bevcli/written").open("a").write("../a.json\n")
    run_all(model, out, Drive(2), force=True)
    assert all(path.read_text() == "mine" for path in kept)
    assert {path.name for path in out.glob("segmentation/00000*.png")} == {"000000.png", "000001.png"}


def test_a_file_that_no_run_wrote_is_not_overwritten(model, tmp_path):
    (tmp_path / "out/segmentation").mkdir(parents=True)
    mine = tmp_path / "out/segmentation/000000.png"
    mine.write_text("mine")
    with pytest.raises(OutputError, match=r"000000\.png: exists already, and no run wrote it"):
        run_all(model, tmp_path / "out", force=True)
    assert mine.read_text() == "mine"


def test_a_second_run_in_the_same_folder_is_refused_and_names_the_first(model, whole, tmp_path):
    refusals = []

    def start_another(frame, prediction):
        for how in ({"force": True}, {"resume": True}):
            with pytest.raises(OutputError, match=f"in use by another run .process {os.getpid()}: ") as error:
                run_all(model, tmp_path / "out", **how)
            refusals.append(error)

    run_all(model, tmp_path / "out", after_frame=start_another)
    assert len(refusals) == 2 * FRAMES
    assert_equals(tmp_path / "out", whole)
    assert not (tmp_path / "out/.bevcli/lock").exists()


def test_a_folder_that_is_deleted_during_the_run_is_an_error(model, tmp_path):
    def delete(frame, prediction):
        if frame.stamp.index == 2:
            shutil.rmtree(tmp_path / "out")

    with pytest.raises(OutputError, match=r"deleted|cannot be written"):
        run_all(model, tmp_path / "out", after_frame=delete)


def test_saving_states_takes_two_percent_of_the_time_at_most(model, tmp_path, monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(run_state.time, "perf_counter", lambda: clock[0])

    def slow_save(path, state):
        clock[0] += 0.5

    monkeypatch.setattr(run_state, "save_state", slow_save)
    saver = run_state.StateSaver(tmp_path / "state")
    spent = 0
    for _ in range(10_000):
        clock[0] += 0.1
        if saver.is_due(run_state.RunnerState()):
            saver.save(run_state.RunState({}, 1, run_state.RunnerState(), None, {}))
            spent += 1
        assert spent * 0.5 <= 0.02 * clock[0] + 0.5  # the first save's time is not known before
    assert spent >= 30
