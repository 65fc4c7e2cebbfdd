"""Ground truth with class names of other data sets; a column of boxes is stated once."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import invoked

from bevcli.errors import InputError
from bevcli.sequences.files.boxes_file import read_boxes
from bevcli.sequences.open import open_sequence

CLASSES = ("Car", "TRUCK", "Tricycle", "lorry", "pedestrian")


def box(name: str, index: int) -> dict:
    return {"class": name, "center": [10.0 + 6 * index, 0.0, 1.0], "size_lwh": [4.0, 2.0, 1.5], "yaw": 0.0}


@pytest.fixture
def labelled(drive: Path) -> Path:
    """The small drive with the same five boxes in each frame, in the ego frame."""
    frames = [
        {
            "frame": 10 + number,
            "timestamp_ns": 1_000_000_000 + number * 500_000_000,
            "world_from_ego": {"translation": [10.0 + 5 * number, 0, 0], "rotation_wxyz": [1, 0, 0, 0]},
            "boxes": [box(name, place) for place, name in enumerate(CLASSES)],
        }
        for number in range(4)
    ]
    content = {"format": "bevcli-boxes/1", "frame_of_reference": "ego", "frames": frames}
    (drive / "ground_truth.json").write_text(json.dumps(content))
    return drive


def classes(sequence) -> list[str]:
    return sequence.load(0).ground_truth.classes.tolist()


def test_names_ignore_case_and_unknown_ones_are_named_once(labelled: Path) -> None:
    sequence = open_sequence(labelled)
    assert classes(sequence) == ["car", "truck", "Tricycle", "lorry", "pedestrian"]
    [note] = [note for note in sequence.notes if "other classes" in note]
    assert "8 boxes have other classes and are not scored: Tricycle (4), lorry (4)" in note


def test_a_class_map_renames_without_case(labelled: Path) -> None:
    sequence = open_sequence(labelled, class_map={"Lorry": "Truck", "tricycle": "bicycle"})
    assert classes(sequence) == ["car", "truck", "bicycle", "truck", "pedestrian"]
    assert not any("other classes" in note for note in sequence.notes)
    with pytest.raises(InputError, match=r'`class_map` .`--class-map`. Lorry=tank: "tank" is not a class'):
        open_sequence(labelled, class_map={"Lorry": "tank"})


def test_ground_truth_can_be_left_out_even_if_it_is_broken(labelled: Path) -> None:
    (labelled / "ground_truth.json").write_text("{")
    frame = open_sequence(labelled, ground_truth=False).load(0)
    assert frame.ground_truth is None
    assert frame.ground_truth_map is None


def test_convert_keeps_other_classes_and_applies_a_map_in_toml(labelled: Path, tmp_path: Path) -> None:
    table = tmp_path / "classes.toml"
    table.write_text('lorry = "truck"\n')
    out = tmp_path / "out"
    invoked("convert", labelled, out, "--class-map", table)
    found = read_boxes(out / "ground_truth.json").frames[0].boxes.classes.tolist()
    assert found == ["car", "truck", "Tricycle", "truck", "pedestrian"]


def test_eval_says_which_classes_it_left_out(labelled: Path, tmp_path: Path) -> None:
    content = json.loads((labelled / "ground_truth.json").read_text())
    for frame in content["frames"]:
        for one in frame["boxes"]:
            one["score"] = 0.9
    predictions = tmp_path / "predictions.json"
    predictions.write_text(json.dumps(content))
    arguments = ["eval", predictions, labelled, "--json"]
    scores = json.loads(invoked(*arguments).stdout)
    assert scores["label_ground_truth_boxes"]["truck"] == 4
    sides = [note for note in scores["notes"] if "Tricycle (4), lorry (4)" in note]
    assert len(sides) == 2
    scores = json.loads(invoked(*arguments, "--class-map", "LORRY=truck").stdout)
    assert scores["label_ground_truth_boxes"]["truck"] == 8
    assert np.isclose(scores["label_aps"]["truck"]["2.0"], 1)


def test_eval_cuts_the_ranges_where_the_models_grid_ends(labelled: Path, tmp_path: Path) -> None:
    content = json.loads((labelled / "ground_truth.json").read_text())
    for frame in content["frames"]:
        frame["boxes"] = [{**box("car", place), "score": 0.9} for place in (0, 4)]
    (labelled / "ground_truth.json").write_text(json.dumps(content))
    predictions = tmp_path / "predictions.json"
    predictions.write_text(json.dumps({**content, "range_m": 30.72}))
    arguments = ["eval", predictions, labelled, "--json"]
    scores = json.loads(invoked(*arguments).stdout)
    assert scores["label_ground_truth_boxes"]["car"] == 4  # at 10 m, but not at 34 m
    assert any("nothing beyond 30.72 m is scored" in note for note in scores["notes"])
    scores = json.loads(invoked(*arguments, "--max-range", "50").stdout)
    assert scores["label_ground_truth_boxes"]["car"] == 8
    assert not any("nothing beyond" in note for note in scores["notes"])
