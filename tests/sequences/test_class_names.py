"""Ground truth with class names of other data sets; a column of boxes is stated once."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import bevcli.geometry.boxes
from bevcli.cli.main import app
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
    notes = [note for note in sequence.notes if "other classes" in note]
    assert len(notes) == 1
    assert "8 boxes have other classes and are not scored: Tricycle (4), lorry (4)" in notes[0]


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
    result = CliRunner().invoke(app, ["convert", str(labelled), str(out), "--class-map", str(table)])
    assert result.exit_code == 0, result.output
    found = read_boxes(out / "ground_truth.json").frames[0].boxes.classes.tolist()
    assert found == ["car", "truck", "Tricycle", "truck", "pedestrian"]


def test_eval_says_which_classes_it_left_out(labelled: Path, tmp_path: Path) -> None:
    content = json.loads((labelled / "ground_truth.json").read_text())
    for frame in content["frames"]:
        for one in frame["boxes"]:
            one["score"] = 0.9
    predictions = tmp_path / "predictions.json"
    predictions.write_text(json.dumps(content))
    arguments = ["eval", str(predictions), str(labelled), "--json"]
    scores = json.loads(CliRunner().invoke(app, arguments).stdout)
    assert scores["label_ground_truth_boxes"]["truck"] == 4
    sides = [note for note in scores["notes"] if "Tricycle (4), lorry (4)" in note]
    assert len(sides) == 2
    scores = json.loads(CliRunner().invoke(app, [*arguments, "--class-map", "LORRY=truck"]).stdout)
    assert scores["label_ground_truth_boxes"]["truck"] == 8
    assert np.isclose(scores["label_aps"]["truck"]["2.0"], 1)


def test_eval_cuts_the_ranges_where_the_models_grid_ends(labelled: Path, tmp_path: Path) -> None:
    content = json.loads((labelled / "ground_truth.json").read_text())
    for frame in content["frames"]:
        frame["boxes"] = [{**box("car", place), "score": 0.9} for place in (0, 4)]
    (labelled / "ground_truth.json").write_text(json.dumps(content))
    predictions = tmp_path / "predictions.json"
    predictions.write_text(json.dumps({**content, "range_m": 30.72}))
    arguments = ["eval", str(predictions), str(labelled), "--json"]
    scores = json.loads(CliRunner().invoke(app, arguments).stdout)
    assert scores["label_ground_truth_boxes"]["car"] == 4  # at 10 m, but not at 34 m
    assert any("nothing beyond 30.72 m is scored" in note for note in scores["notes"])
    scores = json.loads(CliRunner().invoke(app, [*arguments, "--max-range", "50"]).stdout)
    assert scores["label_ground_truth_boxes"]["car"] == 8
    assert not any("nothing beyond" in note for note in scores["notes"])


NEW = '    lanes: Annotated[NDArray[np.int64] | None, Column("lane", "count", recorded="lane")] = None\n'
BEFORE = "    futures: Array | None = None\n"
LIKE_INSTALLED = """
import importlib.util, sys
spec = importlib.util.spec_from_file_location("bevcli.geometry.boxes", sys.argv[1])
sys.modules[spec.name] = module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)

from dataclasses import replace
from pathlib import Path
import numpy as np
from bevcli.sequences.files.boxes_table import write_csv
from bevcli.workshop.scores.detection import with_all_columns
from bevcli.recording.writer import Recording
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes, read_boxes, write_boxes
from bevcli.viewer.recording_reader import read_recording
sys.path.insert(0, sys.argv[3])
from memory_drive import MemoryDrive
from recorded_drive import NamedModel, boxes_ahead, predict

folder, drive = Path(sys.argv[2]), MemoryDrive(1)
boxes, frame = replace(boxes_ahead()[:2], lanes=np.array([7, -1])), drive.load(0)
assert boxes.to_dict()["lane"] == [7, -1]
assert with_all_columns(boxes_ahead()).lanes.tolist() == [-1] * len(boxes_ahead())
file = BoxesFile("world", (FrameBoxes(frame.stamp, frame.world_from_ego, boxes),))
write_boxes(file, folder / "boxes.json")
assert read_boxes(folder / "boxes.json").frames[0].boxes.lanes.tolist() == [7, -1]
write_csv(file, folder / "boxes.csv")
assert [line.rpartition(",")[2] for line in (folder / "boxes.csv").read_text().split()] == ["lane", "7", ""]
with Recording(folder / "r.rrd", drive, NamedModel()) as recording:
    recording.log(frame, replace(predict(frame), boxes=boxes))
assert sorted(read_recording(folder / "r.rrd").frames[0].boxes.lanes.tolist()) == [-1, 7]
"""


@pytest.mark.slow
def test_a_new_column_is_one_line(tmp_path):
    source = Path(bevcli.geometry.boxes.__file__).read_text()
    assert source.count(BEFORE) == 1
    changed = tmp_path / "boxes.py"
    changed.write_text(source.replace(BEFORE, NEW + BEFORE))
    tests = Path(__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", LIKE_INSTALLED, changed, tmp_path, tests], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
