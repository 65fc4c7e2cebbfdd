"""A run that launches the next frame before it waits for a frame: the results are those of one step after the other."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from memory_drive import MemoryDrive, WithoutImages
from simulated_device import simulated
from test_other_devices import CPU, sample_plainly, small_version

from bevcli.errors import InputError
from bevcli.inference.load import Model
from bevcli.inference.runner import Runner, StepOptions
from bevcli.inference.tracking import TrackerConfig
from bevcli.model.prepare import prepare_for_inference
from bevcli.runs.run_into_folder import run_into_folder
from bevcli.sequences.files.boxes_file import read_boxes
from bevcli.workshop.benchmark.made_up import made_up_model
from bevcli.workshop.uniad.uniad import UniAD

FRAMES = 6
TRACKER = TrackerConfig(birth_score=0.0, keep_score=0.0)


class MadeDrive(WithoutImages):
    """A drive of two scenes, with a frame without images. A frame `broken` cannot be read."""

    broken = FRAMES

    def __init__(self):
        super().__init__({1: "all"}, count=FRAMES, scenes="aaaabb")

    def load(self, place):
        if place == self.broken:
            raise InputError(f"frame {place}: is broken")
        return super().load(place)


@pytest.fixture
def overlapping(monkeypatch):
    monkeypatch.setattr(Runner, "overlap", 1)


def steps_of(model, change=lambda prepared: prepared, broken=FRAMES):
    """The steps of a run, and the message of the error that ended it. change: of each frame before its step."""
    runner, drive = Runner(model, CPU, tracker=TRACKER), MadeDrive()
    runner.prepare = lambda frame: change(runner.preprocess(frame))
    drive.broken, steps = broken, []
    try:
        for step in runner.run(drive):
            steps.append(step)
    except (InputError, RuntimeError) as error:
        return steps, str(error)
    return steps, ""


def assert_same(found, expected):
    for (frame, ours, after), (their_frame, theirs, their_after) in zip(found, expected, strict=True):
        assert frame.stamp == their_frame.stamp == ours.stamp
        assert (ours.skipped, ours.not_finite) == (theirs.skipped, theirs.not_finite)
        assert str(ours.started_anew) == str(theirs.started_anew)
        assert ours.bev is theirs.bev is None or torch.equal(ours.bev, theirs.bev)
        for column in ("centers", "scores", "instances"):
            assert np.array_equal(getattr(ours.boxes, column), getattr(theirs.boxes, column))
        assert list(ours.stage_seconds) == list(theirs.stage_seconds)
        assert after.stamp == their_after.stamp
        assert np.array_equal(after.tracks.tracks.numbers, their_after.tracks.tracks.numbers)


def spoilt(index):
    """A change of the frame of an index, whose images become NaN."""
    return lambda x: replace(x, images=x.images * float("nan")) if x.frame.stamp.index == index else x


def cut(index):
    """A change of the frame of an index, whose images get a shape that the model refuses."""
    return lambda x: replace(x, images=x.images[:, :, :1]) if x.frame.stamp.index == index else x


@pytest.mark.parametrize(
    ("asked", "count"),
    [
        ({}, FRAMES),
        ({"change": spoilt(2)}, FRAMES),
        ({"change": spoilt(FRAMES - 1)}, FRAMES),
        ({"change": cut(3)}, 3),
        ({"broken": 3}, 3),
        ({"broken": 0}, 0),
    ],
    ids=["whole", "not finite", "not finite at the end", "error in a step", "error in reading", "error at once"],
)
def test_an_overlapped_run_equals_one_step_after_the_other(mini_model, monkeypatch, asked, count):
    expected, error = steps_of(mini_model, **asked)
    monkeypatch.setattr(Runner, "overlap", 1)
    found, same_error = steps_of(mini_model, **asked)
    assert len(found) == count
    assert_same(found, expected)
    assert same_error == error
    assert bool(error) == (count < FRAMES)


def test_an_error_of_a_finished_step_ends_the_run(mini_model, monkeypatch, overlapping):
    decode, calls = mini_model.decode, []

    def fail_second(outputs):
        calls.append(outputs)
        if len(calls) == 2:
            raise RuntimeError("cannot be decoded")
        return decode(outputs)

    monkeypatch.setattr(mini_model, "decode", fail_second)
    steps, error = steps_of(mini_model)
    assert [prediction.skipped for _, prediction, _ in steps] == [False, True]
    assert error == "cannot be decoded"
    assert len(calls) == 2


def interrupt_and_resume(model, out):
    """A run that ends at a frame that cannot be read, then at the next one, then with the drive."""
    drive = MadeDrive()
    for drive.broken in (4, 5):
        with pytest.raises(InputError, match=f"frame {drive.broken}"):
            run_into_folder(model, drive, out, resume=drive.broken == 5)
        assert len(read_boxes(out / "predictions.json").frames) == drive.broken
    drive.broken = FRAMES
    run_into_folder(model, drive, out, resume=True)


@pytest.mark.usefixtures("unchecked_recordings")
def test_an_interrupted_overlapped_run_has_all_frames(mini_model, tmp_path, overlapping):
    model = Model(mini_model, tracker=TRACKER)
    run_into_folder(model, MadeDrive(), tmp_path / "whole")
    interrupt_and_resume(model, tmp_path / "out")
    for name in ("predictions.json", "tracks.csv"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked_recordings")
def test_an_interrupted_run_on_a_gpu_has_all_frames(mini_model, tmp_path, monkeypatch):
    run_into_folder(Model(mini_model, tracker=TRACKER), MadeDrive(), tmp_path / "cpu")
    with simulated("cuda:0", monkeypatch, sample_plainly) as device:
        interrupt_and_resume(Model(mini_model, device.device, tracker=TRACKER), tmp_path / "gpu")
    found, expected = (read_boxes(tmp_path / name / "predictions.json").frames for name in ("gpu", "cpu"))
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.stamp == theirs.stamp
        np.testing.assert_allclose(ours.boxes.centers, theirs.boxes.centers, atol=1e-3)
        np.testing.assert_array_equal(ours.boxes.instances, theirs.boxes.instances)


@pytest.mark.parametrize(
    "name", ["demo", *(pytest.param(name, marks=pytest.mark.slow) for name in ("v2-t8", "vad-tiny", "tiny"))]
)
def test_a_gpu_gets_the_next_frame_before_results_are_waited_for(name, monkeypatch):
    """Each frame waits once, for its own results: what the device copies has no numbers before."""
    config, count = small_version(name), 4  # the first ones warm up and are captured
    model, drive = made_up_model(config), MemoryDrive(count)
    expected = list(Runner(model, CPU, tracker=TRACKER).run(drive))
    with simulated("cuda:1", monkeypatch, sample_plainly) as device:
        fast = prepare_for_inference(model, device.device)
        upload = lambda prepared: replace(prepared, images=device.tensor(prepared.images))  # noqa: E731
        monkeypatch.setattr("bevcli.inference.runner.image_uploader", lambda device: upload)
        runner = Runner(fast, device.device, tracker=TRACKER)
        begin = runner.begin
        monkeypatch.setattr(runner, "begin", lambda *given: (begin(*given), device.waits.append("launched"))[0])
        found = list(runner.run(drive))
    order = device.waits[device.waits.index("launched") :]
    assert order == ["launched", *["launched", "event"] * (count - 1), "event"]
    for (_, ours, _), (_, theirs, _) in zip(found, expected, strict=True):
        assert ours.stamp == theirs.stamp
        np.testing.assert_allclose(ours.boxes.centers, theirs.boxes.centers, atol=1e-3)
        np.testing.assert_array_equal(ours.boxes.instances, theirs.boxes.instances)


def test_only_what_gains_by_it_is_overlapped(mini_model):
    cuda = torch.device("cuda:0")
    models = {True: mini_model, False: UniAD.__new__(UniAD)}
    for overlaps, model in models.items():
        runner = SimpleNamespace(model=model, device=cuda, options=StepOptions())
        assert Runner.overlap.fget(runner) == overlaps
        assert Runner.overlap.fget(SimpleNamespace(**{**vars(runner), "device": CPU})) == 0
    observed = SimpleNamespace(model=mini_model, device=cuda, options=StepOptions(attention=True))
    assert Runner.overlap.fget(observed) == 0
