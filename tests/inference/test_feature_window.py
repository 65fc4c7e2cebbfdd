"""The history of a run at scene starts, gaps and cuts: a BEVFormer's BEV map, and BEVFormerV2's window of frames."""

import gc
from dataclasses import replace

import pytest
import torch
from memory_drive import MemoryDrive, WithoutImages
from stepping import CPU, run

from bevcli.inference.preprocess import Preprocessor
from bevcli.inference.runner import Runner
from bevcli.workshop.bevformer_v2 import fill_window


def assert_same(one, other):
    assert one.bev.numpy() == pytest.approx(other.bev.numpy(), abs=1e-5)
    assert one.boxes.centers == pytest.approx(other.boxes.centers, abs=1e-4)
    assert one.boxes.scores == pytest.approx(other.boxes.scores, abs=1e-5)


def differs(one, other) -> bool:
    return bool((one.bev - other.bev).abs().max() > 1e-3)


@pytest.mark.parametrize(
    ("frames", "exists", "sources"),
    [
        ([-2, -1, 0], [True, True, True], [0, 1, 2]),
        ([-2, -1, 0], [False, True, True], [1, 1, 2]),
        ([-2, -1, 0], [False, False, True], [2, 2, 2]),
        ([-4, -2, 0], [False, False, True], [2, 2, 2]),
        ([-1, 0, 1, 2], [False, True, True, False], [1, 1, 2, 2]),
        ([0, 1, 2], [True, False, False], [0, 0, 0]),
    ],
)
def test_a_missing_frame_takes_the_nearest_towards_the_current(frames, exists, sources):
    assert fill_window(frames, exists) == sources


@pytest.mark.parametrize("frames", [(-3, -2, -1, 0), (-1, 0, 1)])
def test_every_frame_passes_the_backbone_once(window_model, frames):
    model, calls = window_model(*frames), []
    with model.backbone.register_forward_hook(lambda module, inputs, output: calls.append(len(inputs[0]))):
        predictions, _ = run(model, MemoryDrive(6))
    assert len(predictions) == 6
    assert calls == [6] * 6  # six cameras, six frames


def test_each_frame_of_the_window_is_encoded_once_a_step(window_model):
    model, calls = window_model(-3, -2, -1, 0), []
    with model.encoder.register_forward_hook(lambda *_: calls.append(1)):
        run(model, MemoryDrive(5))
    assert len(calls) == 1 + 2 + 3 + 4 + 4


def test_every_frame_of_the_window_matters(window_model):
    model = window_model(-2, -1, 0)
    whole = run(model, MemoryDrive(3))[0][2]
    for dropped in (0, 1):
        assert differs(whole, run(model, WithoutImages({dropped: "all"}, count=3))[0][2])


@pytest.fixture
def models(mini_model, window_model):
    """A function: the frames of windows -> a BEVFormer, and a BEVFormerV2 of each window."""
    return lambda *windows: [mini_model, *(window_model(*frames) for frames in windows)]


def test_a_run_cut_in_two_equals_the_whole(models):
    sequence = MemoryDrive(5)
    for model in models((-2, -1, 0)):
        whole, _ = run(model, sequence)
        first, state = run(model, sequence, range(3))
        second, _ = run(model, sequence, range(3, 5), state)
        for one, other in zip(whole, first + second, strict=True):
            assert_same(one, other)


def test_an_interrupted_run_that_looks_ahead_goes_on_from_state(window_model):
    model, sequence = window_model(-1, 0, 1, 2), MemoryDrive(6)
    whole, _ = run(model, sequence)
    steps = Runner(model, CPU).run(sequence)
    for _ in range(3):
        _, _, state = next(steps)
    steps.close()
    rest, _ = run(model, sequence, range(3, 6), state)
    for one, other in zip(whole[3:], rest, strict=True):
        assert_same(one, other)


@pytest.mark.slow
def test_a_scene_change_equals_a_fresh_start(models):
    """Inside a window too."""
    sequence = MemoryDrive(5, scenes="aaabb")
    for model in models((-3, -2, -1, 0), (-1, 0, 1)):
        whole, _ = run(model, sequence)
        assert [str(p.started_anew or "") for p in whole] == ["first frame", "", "", "new scene", ""]
        for places in (range(3), range(3, 5)):
            fresh, _ = run(model, sequence, places)
            for place, prediction in zip(places, fresh, strict=True):
                assert_same(whole[place], prediction)


def test_a_gap_in_time_starts_anew(models):
    sequence = MemoryDrive(2, step_s=2.5)
    for model in models((-1, 0), (0, 1)):
        predictions, _ = run(model, sequence)
        alone, _ = run(model, sequence, [1])
        assert str(predictions[1].started_anew) == "gap of 2.5 s"
        assert_same(predictions[1], alone[0])


def test_without_history_every_frame_stands_alone(models):
    sequence = MemoryDrive(3)
    for model in models((-1, 0), (-1, 0, 1)):
        predictions, _ = run(model, sequence, temporal=False)
        assert {str(p.started_anew or "") for p in predictions} == {"history is off"}
        alone, _ = run(model, sequence, [1], temporal=False)
        assert_same(predictions[1], alone[0])


def test_a_later_frame_changes_the_current_one(window_model):
    model, sequence = window_model(-1, 0, 1), MemoryDrive(3)
    whole, cut = run(model, sequence)[0], run(model, sequence, range(2))[0]
    assert_same(whole[0], cut[0])
    assert differs(whole[1], cut[1])


def test_a_model_of_one_frame_says_that_it_uses_no_history(window_model):
    predictions, _ = run(window_model(0), MemoryDrive(2))
    assert {str(p.started_anew or "") for p in predictions} == {"the model uses no history"}


def test_a_frame_without_images_passes_the_state_on(models):
    for model in models((-1, 0), (-1, 0, 1, 2)):
        predictions, _ = run(model, WithoutImages({1: "all"}, count=4))
        assert [p.skipped for p in predictions] == [False, True, False, False]
        assert len(predictions[1].boxes) == 0
        assert predictions[2].started_anew is None
        spanned, _ = run(model, MemoryDrive(4), [0, 2, 3])
        assert_same(predictions[2], spanned[1])


def test_a_probe_sees_the_current_frame(window_model):
    model, probes = window_model(-1, 0), ((0.0, 12.0),)
    sequence = MemoryDrive(2)
    view = run(model, sequence, attention=True, probes=probes)[0][1].attention
    alone = run(model, sequence, [1], attention=True, probes=probes)[0][0].attention
    assert view.history_weight is None
    assert view.probes[0].cameras["CAM_FRONT"].pixels == pytest.approx(alone.probes[0].cameras["CAM_FRONT"].pixels)


@pytest.mark.slow
def test_memory_stays_flat_over_200_frames_of_a_window_of_eight(window_model):
    model = window_model(*range(-7, 1))
    runner = Runner(model, CPU)
    prepared = [Preprocessor(model.config)(MemoryDrive(1).load(0))] * 200
    state, counts = None, []
    for index, frame in enumerate(prepared):
        stamp = replace(frame.frame.stamp, index=index, timestamp_ns=10**18 + index * 500_000_000)
        state, _ = runner.step(state, replace(frame, frame=replace(frame.frame, stamp=stamp)))
        if index in (20, 199):
            gc.collect()
            counts.append(sum(issubclass(type(thing), torch.Tensor) for thing in gc.get_objects()))
    assert len(state.memory.frames) == 7
    assert counts[1] <= counts[0] + 5
