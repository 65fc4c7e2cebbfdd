"""Runs with the tracker: the files that hold identities, and boxes that are the same without it."""

import csv
import json
from dataclasses import fields, replace

import numpy as np
import pytest
from memory_drive import MemoryDrive, WithoutImages

from bevcli.config import TRACKING, load_table
from bevcli.errors import ConfigError
from bevcli.geometry.boxes import Boxes3D
from bevcli.inference import run
from bevcli.inference.load import Model
from bevcli.inference.tracking import TrackerConfig, track
from bevcli.recording import RecordingOptions
from bevcli.runs.run_into_folder import RunOptions, run_in_folder, run_into_folder
from bevcli.sequences.files.boxes_file import read_boxes

# The mini model is untrained: its scores and places mean nothing, so every box may start a track.
EAGER = TrackerConfig(birth_score=0.0, keep_score=0.0)
TRACK_COLUMNS = ("instances", "track_scores", "duplicates")


@pytest.fixture
def model(mini_model):
    return Model(mini_model, tracker=EAGER)


def predictions(model, sequence, **options):
    return [prediction for _, prediction in run(model, sequence, **options)]


def test_the_tracker_changes_no_number(model):
    with_tracks = predictions(model, MemoryDrive(3))
    without = predictions(model, MemoryDrive(3), track=False)
    for one, other in zip(with_tracks, without, strict=True):
        for column in fields(Boxes3D):
            if column.name in TRACK_COLUMNS:
                assert getattr(other.boxes, column.name) is None
                assert len(getattr(one.boxes, column.name)) == len(one.boxes)
            else:
                assert np.array_equal(getattr(one.boxes, column.name), getattr(other.boxes, column.name))


def test_identities_reach_boxes_of_every_frame_of_reference(model):
    prediction = predictions(model, MemoryDrive(1))[0]
    assert (prediction.boxes.instances != "").any()
    for boxes in (prediction.boxes_ego, prediction.boxes_world):
        assert list(boxes.instances) == list(prediction.boxes.instances)


def tracked(results, state=None):
    """State and prediction after each frame of a run."""
    for _, prediction in results:
        state, prediction = track(EAGER, state, prediction)
        yield state, prediction


def test_a_frame_without_images_leaves_the_tracks_alone(model):
    states = [state for state, _ in tracked(run(model, WithoutImages({1: "all"}, count=3), track=False))]
    assert states[1] is states[0]
    assert states[2].stamp.index == 2


def test_predictions_and_tracks_files_hold_the_identities(model, tmp_path):
    options = RunOptions(recording=RecordingOptions("minimal", score=0.0))
    with run_in_folder(model, MemoryDrive(3), tmp_path, options) as running:
        seen = [prediction for _, prediction in running.frames]
    frames = read_boxes(tmp_path / "predictions.json").frames
    for frame, prediction in zip(frames, seen, strict=True):
        assert list(frame.boxes.instances) == list(prediction.boxes.instances)
        assert np.array_equal(frame.boxes.track_scores, prediction.boxes.track_scores, equal_nan=True)
        duplicates = frame.boxes.duplicates  # the file states them only where there are any
        assert list(prediction.boxes.duplicates) == [False] * 20 if duplicates is None else list(duplicates)
    with (tmp_path / "tracks.csv").open() as file:
        rows = list(csv.DictReader(file))
    expected = [(frame, box) for frame in frames for box in np.flatnonzero(frame.boxes.instances != "")]
    assert len(rows) == len(expected) > 0
    for row, (frame, box) in zip(rows, expected, strict=True):
        boxes = frame.boxes
        assert (row["frame"], row["instance"]) == (str(frame.stamp.index), boxes.instances[box])
        assert (row["class"], row["frame_of_reference"]) == (boxes.classes[box], "world")
        assert float(row["track_score"]) == boxes.track_scores[box]
        assert [float(row[key]) for key in ("x", "y", "z")] == list(boxes.centers[box])
    instances = {name for frame in frames for name in frame.boxes.instances if name}
    assert json.loads((tmp_path / "summary.json").read_text())["tracks"] == len(instances)


def test_a_run_without_tracks_writes_none(model, tmp_path):
    options = RunOptions(track=False, recording=RecordingOptions("minimal"))
    summary = run_into_folder(model, MemoryDrive(2), tmp_path, options)
    assert not (tmp_path / "tracks.csv").exists()
    assert all(frame.boxes.instances is None for frame in read_boxes(tmp_path / "predictions.json").frames)
    assert summary.to_dict()["tracks"] is None
    assert "\ntracks " not in summary.table()


def test_the_models_file_holds_the_parameters(tmp_path):
    assert load_table("tiny", TRACKING, TrackerConfig) == TrackerConfig()
    assert load_table("demo", TRACKING, TrackerConfig) != TrackerConfig()
    file = tmp_path / "mine.toml"
    file.write_text("[tracking]\nbirth_score = 0.5\n[tracking.gates_m]\ncar = 7\n")
    own = load_table(file, TRACKING, TrackerConfig)
    assert own == replace(TrackerConfig(), birth_score=0.5, gates_m={"car": 7.0})
    file.write_text("[tracking]\nbirth = 0.5\n")
    with pytest.raises(ConfigError, match=r'unknown key "tracking\.birth"; did you mean "birth_score"'):
        load_table(file, TRACKING, TrackerConfig)
    file.write_text("[tracking]\nbirth_score = 0.1\nkeep_score = 0.2\n")
    with pytest.raises(ConfigError, match=r"\[tracking\]: keep_score and birth_score"):
        load_table(file, TRACKING, TrackerConfig)
