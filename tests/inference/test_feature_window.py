"""The history of a run at scene starts, gaps and cuts: a BEV map, BEVFormerV2's window of frames, UniAD's tracks."""

import gc
from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from interrupted import run_frames
from memory_drive import MemoryDrive, WithoutImages
from shared_fixtures import stirred
from stepping import CPU, run

from bevcli.inference import run as run_model
from bevcli.inference.load import Model
from bevcli.inference.preprocess import Preprocessor
from bevcli.inference.runner import Runner
from bevcli.inference.tracking import TrackerConfig
from bevcli.model.config import ModelConfig
from bevcli.model.prepare import prepare_for_inference
from bevcli.recording import RecordingOptions
from bevcli.runs.run_into_folder import RunOptions, run_into_folder
from bevcli.sequences.files.boxes_file import read_boxes
from bevcli.workshop.bevformer_v2 import fill_window
from bevcli.workshop.uniad.map_head import MapHeadConfig
from bevcli.workshop.uniad.uniad import TrackQueryConfig, UniAD, UniADConfig


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


MAP_HEAD = MapHeadConfig(
    thing_queries=12, max_things=6, encoder_layers=1, location_layers=2, thing_mask_layers=1, stuff_mask_layers=1,
    attention_heads=4, feed_forward_width=48, mask_feed_forward_width=48,
)  # fmt: skip


@pytest.fixture(scope="module")
def config(mini_config: ModelConfig) -> UniADConfig:
    settings = {field.name: getattr(mini_config, field.name) for field in fields(mini_config)}
    motion = replace(mini_config.ego_motion, first_frame="original")
    tracks = TrackQueryConfig(birth_score=0.3, keep_score=0.25, max_misses=2, memory_interval=2, attention_heads=4)
    changes = {"name": "mini-uniad", "ego_motion": motion}
    return UniADConfig(**{**settings, **changes}, track_queries=tracks, map_head=MAP_HEAD)


@pytest.fixture(scope="module")
def model(config: UniADConfig) -> UniAD:
    """Random weights with which some queries start tracks in each frame, and some tracks end."""
    model = stirred(lambda: UniAD(config))
    with torch.no_grad():
        for branch in model.detection_head.class_branches:
            branch[-1].bias.fill_(-1.0)
    return model


def identities(prediction) -> set[int]:
    return {int(name) for name in prediction.boxes.instances if name}


def assert_same_tracks(one, other, *, ids: bool = True) -> None:
    assert one.bev.numpy() == pytest.approx(other.bev.numpy(), abs=1e-5)
    assert one.boxes.centers == pytest.approx(other.boxes.centers, abs=1e-3)
    assert one.boxes.scores == pytest.approx(other.boxes.scores, abs=1e-5)
    assert np.array_equal(one.segmentation.cells, other.segmentation.cells)
    if ids:
        assert one.boxes.instances.tolist() == other.boxes.instances.tolist()


@pytest.fixture(scope="module")
def whole(model):
    return run(model, MemoryDrive(6))[0]


def test_tracks_are_born_go_on_and_end(whole):
    found = [identities(prediction) for prediction in whole]
    assert all(found)
    assert all(before & now for before, now in pairwise(found))
    assert max(found[-1]) > max(found[0])
    assert found[0] - found[-1]


def test_boxes_with_an_identity_have_their_score_as_track_score(whole):
    boxes = whole[2].boxes
    followed = boxes.instances != ""
    assert np.array_equal(boxes.track_scores[followed], boxes.scores[followed])
    assert np.isnan(boxes.track_scores[~followed]).all()
    assert (boxes.scores[followed] >= 0.25).all()
    assert len(set(boxes.instances[followed])) == followed.sum()


@pytest.mark.parametrize("cut", [pytest.param(1, marks=pytest.mark.slow), 3, pytest.param(5, marks=pytest.mark.slow)])
def test_a_tracked_run_cut_in_two_equals_the_whole(model, whole, cut):
    first, state = run(model, MemoryDrive(6), range(cut))
    second, _ = run(model, MemoryDrive(6), range(cut, 6), state)
    for one, other in zip(whole, first + second, strict=True):
        assert_same_tracks(one, other)


def test_the_prepared_model_gives_the_same_tracks(model, whole):
    found, _ = run(prepare_for_inference(model, CPU), MemoryDrive(6))
    for one, other in zip(whole, found, strict=True):
        assert one.boxes.instances.tolist() == other.boxes.instances.tolist()
        assert one.boxes.centers == pytest.approx(other.boxes.centers, abs=1e-2)


def zero_first_frame(model) -> UniAD:
    """The same weights; a scene's first frame has no motion, so that it does not depend on the scene before."""
    config = replace(model.config, ego_motion=replace(model.config.ego_motion, first_frame="zero"))
    other = UniAD(config).eval()
    other.load_state_dict(model.state_dict())
    return other


def test_a_scene_change_ends_all_tracks_and_no_identity_returns(model):
    sequence = MemoryDrive(6, scenes="aaabbb")
    for network in (model, zero_first_frame(model)):
        predictions, _ = run(network, sequence)
        assert [str(p.started_anew or "") for p in predictions] == ["first frame", "", "", "new scene", "", ""]
        before, after = (set().union(*map(identities, part)) for part in (predictions[:3], predictions[3:]))
        assert after
        assert min(after) > max(before)
    fresh, _ = run(network, sequence, range(3, 6))
    for one, other in zip(predictions[3:], fresh, strict=True):
        assert_same_tracks(one, other, ids=False)
        assert identities(one) == {name + min(after) for name in identities(other)}


def test_a_first_frame_sees_the_motion_since_the_scene_before(model):
    """As in the released code. With first_frame = "zero" it sees none: the two runs differ from there on."""
    sequence = MemoryDrive(4, scenes="aabb")
    with_motion, without = (run(network, sequence)[0] for network in (model, zero_first_frame(model)))
    assert (with_motion[2].bev - without[2].bev).abs().max() > 1e-3


def test_without_history_frames_stand_alone_without_identities(model):
    predictions, _ = run(model, MemoryDrive(3), temporal=False)
    assert {str(p.started_anew or "") for p in predictions} == {"history is off"}
    alone, _ = run(model, MemoryDrive(3), [1], temporal=False)
    assert_same_tracks(predictions[1], alone[0], ids=False)
    assert predictions[1].boxes.instances is None


def test_a_frame_without_images_passes_the_tracks_on(model):
    predictions, _ = run(model, WithoutImages({1: "all"}, count=4))
    assert [p.skipped for p in predictions] == [False, True, False, False]
    spanned, _ = run(model, MemoryDrive(4), [0, 2, 3])
    assert_same_tracks(predictions[2], spanned[1])


def test_a_scene_that_begins_without_images_keeps_no_identities(model):
    predictions, _ = run(model, WithoutImages({2: "all"}, count=4, scenes="aabb"))
    assert predictions[3].started_anew
    assert min(identities(predictions[3])) > max(identities(predictions[1]))


def test_identities_go_on_after_a_frame_that_is_not_finite(model):
    runner, preprocessor = Runner(model, CPU, tracker=TrackerConfig()), Preprocessor(model.config)
    frames = [preprocessor(MemoryDrive(3).load(place)) for place in range(3)]
    state, first = runner.step(None, frames[0])
    spoilt = frames[1].images.clone()
    spoilt[0, 0, 0, 0, 0] = float("nan")
    state, lost = runner.step(state, replace(frames[1], images=spoilt))
    assert lost.not_finite == "input images"
    _, last = runner.step(state, frames[2])
    assert str(last.started_anew) == "first frame"
    assert min(identities(last)) > max(identities(first))


@pytest.fixture
def loaded(model) -> Model:
    return Model(model, tracker=TrackerConfig(birth_score=0.0, keep_score=0.0))


def test_a_run_takes_the_models_identities_none_without_tracking(loaded, whole):
    tracked = [prediction for _, prediction in run_model(loaded, MemoryDrive(3))]
    for one, other in zip(tracked, whole, strict=False):
        assert one.boxes.instances.tolist() == other.boxes.instances.tolist()
    for _, prediction in run_model(loaded, MemoryDrive(2), track=False):
        assert prediction.boxes.instances is None
        assert prediction.boxes.duplicates is None


def test_without_history_the_tracker_gives_identities(loaded):
    for _, prediction in run_model(loaded, MemoryDrive(2), temporal=False, unseen=True):
        assert (prediction.boxes.instances != "").all()  # this tracker starts a track from every box


@pytest.mark.slow
def test_an_interrupted_run_is_resumed_with_its_tracks(loaded, tmp_path):
    options = RunOptions(recording=RecordingOptions(score=0.5))
    drive = MemoryDrive(5, scenes="aaabb")
    run_into_folder(loaded, drive, tmp_path / "whole", options)
    run_frames(2, loaded, drive, tmp_path / "cut", options)
    run_frames(4, loaded, drive, tmp_path / "cut", options, resume=True)
    run_into_folder(loaded, drive, tmp_path / "cut", options, resume=True)
    for name in ("predictions.json", "tracks.csv", "segmentation/000004.png", "segmentation/map.json"):
        assert (tmp_path / "cut" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert any((frame.boxes.instances != "").any() for frame in read_boxes(tmp_path / "whole/predictions.json").frames)
