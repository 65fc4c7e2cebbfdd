"""UniAD in a run: its BEV map and tracks go on from frame to frame, over cuts, gaps, scene changes and lost frames."""

from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from interrupted import run_frames
from memory_drive import MemoryDrive, WithoutImages
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
from bevcli.workshop.uniad.map_head import MapHeadConfig
from bevcli.workshop.uniad.uniad import TrackQueryConfig, UniAD, UniADConfig

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
    torch.manual_seed(0)
    model = UniAD(config).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
        for branch in model.detection_head.class_branches:
            branch[-1].bias.fill_(-1.0)
    return model


def identities(prediction) -> set[int]:
    return {int(name) for name in prediction.boxes.instances if name}


def assert_same(one, other, *, ids: bool = True) -> None:
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
def test_a_run_cut_in_two_equals_the_whole(model, whole, cut):
    first, state = run(model, MemoryDrive(6), range(cut))
    second, _ = run(model, MemoryDrive(6), range(cut, 6), state)
    for one, other in zip(whole, first + second, strict=True):
        assert_same(one, other)


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
        assert_same(one, other, ids=False)
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
    assert_same(predictions[1], alone[0], ids=False)
    assert predictions[1].boxes.instances is None


def test_a_frame_without_images_passes_the_tracks_on(model):
    predictions, _ = run(model, WithoutImages({1: "all"}, count=4))
    assert [p.skipped for p in predictions] == [False, True, False, False]
    spanned, _ = run(model, MemoryDrive(4), [0, 2, 3])
    assert_same(predictions[2], spanned[1])


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
