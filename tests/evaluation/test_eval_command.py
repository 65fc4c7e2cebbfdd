"""`bevcli eval` from the command line: files in; numbers, tables, plots and one-line errors out."""

import csv
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import invoked
from made_boxes import as_predictions, made_boxes, random_truth

from bevcli.errors import InputError, OutputError
from bevcli.frame import BevMap, FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Pose
from bevcli.sequences.files.boxes_file import BoxesFile, BoxesWriter, FrameBoxes, read_boxes
from bevcli.sequences.files.map_folder import write_map
from bevcli.workshop.scores.evaluate import evaluate
from bevcli.workshop.scores.inputs import open_ground_truth, open_predictions, pair_frames, without_cycles_in_racks
from bevcli.workshop.scores.tables import Table, write_csv, write_latex


def write_frames(path: Path, frames: list[Boxes3D], reference: str = "ego", pose: Pose | None = None) -> Path:
    with BoxesWriter(path, reference) as writer:
        for place, boxes in enumerate(frames):
            writer.write(FrameBoxes(FrameStamp(place, "s", place * 500_000_000), pose, boxes))
    return path


def scored(folder: Path, found: list[Boxes3D], truth: list[Boxes3D]) -> dict[str, Any]:
    """The scores of files of boxes in the ego frame, whose poses are known."""
    sides = {"found": found, "truth": truth}
    files = (write_frames(folder / f"{name}.json", boxes, pose=Pose.identity()) for name, boxes in sides.items())
    return evaluated(*files)


def evaluated(*arguments: Path | str) -> dict[str, Any]:
    return json.loads(invoked("eval", *arguments, "--json").stdout)


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """Predictions of middling quality in the ego frame, and their ground truth."""
    truth = random_truth(21, frames=3)
    found = as_predictions(truth, 22, noise_m=0.6, false_per_frame=15)
    return (
        write_frames(tmp_path / "predictions.json", found, pose=Pose.identity()),
        write_frames(tmp_path / "ground_truth.json", truth, pose=Pose.identity()),
    )


def test_the_json_has_the_devkits_keys(files: tuple[Path, Path]) -> None:
    scores = evaluated(*files)
    keys = {"label_aps", "mean_dist_aps", "mean_ap", "label_tp_errors", "tp_errors", "tp_scores", "nd_score", "cfg"}
    assert keys <= set(scores)
    assert set(scores["label_aps"]["car"]) == {"0.5", "1.0", "2.0", "4.0"}
    assert scores["label_tp_errors"]["traffic_cone"]["vel_err"] is None
    assert 0 < scores["mean_ap"] < 1
    assert 0 < scores["nd_score"] < 1
    assert scores["frames"] == 3
    assert scores["iou"] is None
    assert scores["notes"] == []
    assert len(scores["recall_by_visibility"]) == 4


def test_predictions_without_a_box_score_zero_with_a_note(tmp_path: Path) -> None:
    scores = scored(tmp_path, [Boxes3D.empty()] * 3, random_truth(21, frames=3))
    assert (scores["mean_ap"], scores["nd_score"]) == (0, 0)
    assert any("the predictions contain no box" in note for note in scores["notes"])


def test_max_range_leaves_out_what_is_farther(files: tuple[Path, Path]) -> None:
    scores = evaluated(*files, "--max-range", "12")
    assert scores["ground_truth_boxes"] < evaluated(*files)["ground_truth_boxes"]
    assert max(scores["cfg"]["class_range"].values()) == 12
    assert [(part["from_m"], part["to_m"]) for part in scores["by_range"]] == [(0, 10), (10, 12)]


def test_class_ranges_apply_only_with_an_ego_pose(tmp_path: Path) -> None:
    far = random_truth(23, frames=1)[0]
    far = replace(far, centers=far.centers + [100.0, 0, 0])
    truth = write_frames(tmp_path / "ground_truth.json", [far])
    found = write_frames(tmp_path / "predictions.json", as_predictions([far], 24))
    scores = evaluated(found, truth)
    assert scores["mean_ap"] == pytest.approx(1)
    assert any("class ranges are not applied" in note for note in scores["notes"])
    posed = write_frames(tmp_path / "posed.json", [far], pose=Pose.identity())
    assert evaluated(found, posed)["ground_truth_boxes"] == 0


def test_absent_classes_and_attributes_are_noted(tmp_path: Path) -> None:
    truth = [boxes[boxes.classes == "car"] for boxes in random_truth(25)]
    truth = [replace(boxes, attributes=None) for boxes in truth]
    notes = scored(tmp_path, as_predictions(truth, 26), truth)["notes"]
    assert any("no ground truth of truck" in note and "without them mAP 1.000, NDS 1.000" in note for note in notes)
    assert any("has no attributes" in note for note in notes)


def test_predictions_without_attributes_get_them_by_speed(tmp_path: Path) -> None:
    truth = [boxes[boxes.classes == "car"] for boxes in random_truth(27)]
    fast = [replace(boxes, velocities=np.full((len(boxes), 2), 3.0)) for boxes in truth]
    found = [replace(boxes, attributes=None) for boxes in as_predictions(fast, 28)]
    assert scored(tmp_path, found, fast)["label_tp_errors"]["car"]["attr_err"] == 0


def scored_maps(folder: Path, of_run: int, of_drive: int, frames: int = 1, **classes: Any) -> dict[str, Any]:
    """The scores of a run and a drive that have a map of one frame, each with one value in all cells."""
    parts = {"predictions": ("segmentation", of_run), "ground_truth": ("ground_truth_map", of_drive)}
    for name, (maps, value) in parts.items():
        (folder / name).mkdir()
        boxes = as_predictions(random_truth(29, frames=frames), 30)
        write_frames(folder / name / f"{name}.json", boxes, pose=Pose.identity())
        given = classes if name == "predictions" else {}
        write_map(folder / name / maps, 0, BevMap(np.full((4, 4), value, np.uint8), (-2, 2), (-2, 2), **given))
    return evaluated(*(folder / name for name in parts))


def test_maps_next_to_the_files_are_scored(tmp_path: Path) -> None:
    scores = scored_maps(tmp_path, 1, 9, frames=2)
    assert scores["iou"] == {
        "drivable_road": 1, "lane_boundary": None, "pedestrian_crossing": None, "vehicle": 0,
    }  # fmt: skip
    assert scores["map_frames"] == 1
    assert any("1 of 2 frames lack a map" in note for note in scores["notes"])


@pytest.mark.parametrize(
    ("classes", "iou", "note"),
    [
        (
            {"drivable_area": 1, "pedestrian_crossing": 2},
            {"pedestrian_crossing": 1},
            "map classes on one side only, not scored: drivable_area, drivable_road, lane_boundary, vehicle",
        ),
        ({"drivable_area": 1, "divider": 2}, None, "maps are not scored: they have no class in common"),
    ],
)
def test_only_map_classes_of_both_sides_are_scored(
    tmp_path: Path, classes: dict[str, int], iou: dict[str, float] | None, note: str
) -> None:
    scores = scored_maps(tmp_path, 2, 4, classes=classes)
    assert scores["iou"] == iou
    assert any(note in text for text in scores["notes"])


@pytest.mark.slow
def test_plots_are_not_empty(tmp_path: Path, files: tuple[Path, Path]) -> None:
    evaluated(*files, "--plot", tmp_path / "plots")
    names = {"precision_recall.png", "errors_by_range.png", "misses_and_false_alarms.png"}
    assert {path.name for path in (tmp_path / "plots").iterdir()} == names
    for name in names:
        image = cv2.imread(str(tmp_path / "plots" / name))
        assert image is not None
        assert min(image.shape[:2]) > 600
        assert (image < 200).any(axis=2).mean() > 0.005


@pytest.mark.slow
def test_plots_without_boxes_are_drawn(tmp_path: Path) -> None:
    empty = write_frames(tmp_path / "empty.json", [Boxes3D.empty()], pose=Pose.identity())
    evaluated(empty, empty, "--plot", tmp_path / "plots")
    assert len(list((tmp_path / "plots").iterdir())) == 3


def test_mistakes_are_named(tmp_path: Path, files: tuple[Path, Path]) -> None:
    with pytest.raises(InputError, match=r'ground_truth\.json: frame 0: boxes have no "score"'):
        open_predictions(files[1])
    (tmp_path / "other").mkdir()
    with pytest.raises(InputError, match=r"other.predictions\.json: the file is missing"):
        open_predictions(tmp_path / "other")
    with pytest.raises(InputError, match='has no scene "x"'):
        open_ground_truth(files[1], scene="x")


def test_bicycles_in_a_bicycle_rack_are_left_out() -> None:
    along_y = {"sizes_lwh": (6.0, 2.0, 2.0), "yaws": np.pi / 2}
    rack = made_boxes([(10.0, 0, 1)], "static_object.bicycle_rack", scores=1.0, **along_y)
    places = [(10.0, 2.5, 1.0), (12.5, 0.0, 1.0), (10.0, -2.0, 1.0), (10.0, 0.0, 3.0), (10.0, 0.0, 1.0)]
    names = ["bicycle", "bicycle", "motorcycle", "bicycle", "pedestrian"]
    boxes = made_boxes(places, names, sizes_lwh=1.0, scores=1.0)
    frame = FrameBoxes(FrameStamp(0, "s", 0), Pose.identity(), boxes, {"sample_token": "t"})
    file = BoxesFile("world", (frame,))
    pairs = without_cycles_in_racks(pair_frames(file, file), {"t": rack})
    for kept in (pairs.predictions[0].boxes, pairs.ground_truth[0].boxes):
        np.testing.assert_array_equal(kept.centers, [places[1], places[3], places[4]])


def test_a_nuscenes_root_and_its_conversion_have_the_same_scores(shared: Path, tmp_path: Path) -> None:
    native, root = shared / "data" / "nuscenes-scene-0103", shared / "data" / "nuscenes-mini-4"
    truth = read_boxes(native / "ground_truth.json")
    found = as_predictions([frame.boxes for frame in truth.frames], 31, noise_m=0.5)
    with BoxesWriter(tmp_path / "predictions.json", "world") as writer:
        for frame, boxes in zip(truth.frames, found, strict=True):
            writer.write(replace(frame, boxes=boxes))
    from_root = evaluated(tmp_path / "predictions.json", root)
    from_native = evaluated(tmp_path / "predictions.json", native)
    assert from_root["frames"] == from_native["frames"] == 4
    # The root also knows points in boxes and attributes; what both know is equal.
    assert from_root["ground_truth_boxes"] <= from_native["ground_truth_boxes"]
    assert from_root["label_aps"]["car"] == pytest.approx(from_native["label_aps"]["car"])


def test_the_command_prints_what_the_library_returns(files: tuple[Path, Path]) -> None:
    scores = evaluate(*files, max_range=20.0)
    assert evaluated(*files, "--max-range", "20") == scores.to_dict()
    result = invoked("eval", *files, "--max-range", 20)
    assert result.stdout == scores.table() + "\n"
    assert max(map(len, result.stdout.splitlines())) <= 115


@pytest.fixture
def tracked_files(tmp_path: Path) -> tuple[Path, Path]:
    """Five frames of 14 objects that move 1 m a frame, and predictions that lose and exchange identities."""
    first = random_truth(31, frames=1, per_class=2)[0]
    first = replace(
        first, instances=np.array([f"object-{k}" for k in range(len(first))]), num_points=np.full(len(first), 9)
    )
    truth = [replace(first, centers=first.centers + (frame, 0, 0)) for frame in range(5)]
    found = []
    for frame, boxes in enumerate(truth):
        count = len(boxes)
        instances = np.roll(boxes.instances, 1) if frame == 3 else boxes.instances
        scores = np.full(count, 0.8)
        found.append(replace(boxes, instances=instances, scores=scores, track_scores=scores))
    return (
        write_frames(tmp_path / "tracked.json", found, "world", Pose.identity()),
        write_frames(tmp_path / "tracked_truth.json", truth, "world", Pose.identity()),
    )


def test_tracks_are_scored_when_asked_for(tracked_files: tuple[Path, Path]) -> None:
    assert "tracking" not in evaluated(*tracked_files)
    tracking = evaluated(*tracked_files, "--tracking")["tracking"]
    expected = evaluate(*tracked_files, tracking=True).tracking
    assert expected is not None
    assert tracking["amota"] == pytest.approx(expected.overall["amota"])
    assert tracking["label_metrics"]["ids"]["car"] == expected.classes["car"].metrics["ids"]
    assert set(tracking["label_metrics"]["amota"]) == {
        "bicycle", "bus", "car", "motorcycle", "pedestrian", "trailer", "truck",
    }  # fmt: skip
    assert (tracking["scenes"], tracking["frames"]) == (1, 5)
    assert tracking["recall"] == 1
    result = invoked("eval", *tracked_files, "--tracking")
    for name in ("AMOTA", "AMOTP", "MOTA", "IDS", "FRAG", "TID", "LGD", "identity switches"):
        assert name in result.stdout


def test_tracks_cannot_be_scored_without_identities(tracked_files: tuple[Path, Path], files: tuple[Path, Path]) -> None:
    with pytest.raises(InputError, match=r'ground truth: scene "s" frame 0: .* boxes have no "instance"'):
        evaluate(tracked_files[0], files[1], tracking=True)
    with pytest.raises(InputError, match='predictions: no box has an "instance"'):
        evaluate(files[0], tracked_files[1], tracking=True)


def test_frames_of_another_rate_are_noted(tmp_path: Path, tracked_files: tuple[Path, Path]) -> None:
    def slowed(path: Path) -> Path:
        file = read_boxes(path)
        with BoxesWriter(tmp_path / f"slow-{path.name}", "world") as writer:
            for frame in file.frames:
                stamp = replace(frame.stamp, timestamp_ns=4 * frame.stamp.timestamp_ns)
                writer.write(replace(frame, stamp=stamp))
        return tmp_path / f"slow-{path.name}"

    notes = evaluate(*map(slowed, tracked_files), tracking=True).notes
    assert any("frames are 2 s apart, but TID and LGD count 0.5 s" in note for note in notes)
    assert not any("apart" in note for note in evaluate(*tracked_files, tracking=True).notes)


def values_in(path: Path) -> dict[tuple[str, str, str], str]:
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    values = {(row["table"], row["row"], row["column"]): row["value"] for row in rows}
    assert len(values) == len(rows)  # each names one number
    return values


def test_tables_of_one_model_have_the_numbers_of_the_json(tmp_path: Path, tracked_files: tuple[Path, Path]) -> None:
    out = tmp_path / "made" / "scores.csv"
    scores = evaluated(*tracked_files, "--tracking", "--csv", out, "--latex", tmp_path / "scores.tex")
    values = values_in(out)
    assert float(values["classes", "car", "AP"]) == scores["mean_dist_aps"]["car"]
    assert float(values["classes", "all", "NDS"]) == scores["nd_score"]
    assert float(values["AP by range", "mAP", "0-10 m"]) == scores["by_range"][0]["mean_ap"]
    assert float(values["tracks", "all", "AMOTA"]) == scores["tracking"]["amota"]
    assert float(values["errors of tracks", "car", "IDS"]) == scores["tracking"]["label_metrics"]["ids"]["car"]
    assert values["classes", "traffic_cone", "AVE m/s"] == ""
    text = (tmp_path / "scores.tex").read_text()
    tables = re.findall(r"^% (.*)\n\\begin\{tabular\}", text, flags=re.MULTILINE)
    assert tables == list(dict.fromkeys(table for table, _, _ in values))
    assert r"traffic\_cone & " in text


def test_tables_of_two_models_have_both(tmp_path: Path) -> None:
    truth = random_truth(41, frames=5, per_class=2)
    sides = (as_predictions(truth, 42, noise_m=1.0), as_predictions(truth, 43, noise_m=0.3), truth)
    files = [write_frames(tmp_path / f"{k}.json", side, pose=Pose.identity()) for k, side in enumerate(sides)]
    scores = evaluated(*files, "--csv", tmp_path / "s.csv", "--latex", tmp_path / "s.tex")
    values, of_car = values_in(tmp_path / "s.csv"), scores["mean_dist_aps"]["car"]
    columns = ("AP A", "AP B", "95 % interval low", "95 % interval high")
    expected = [*of_car["values"], *of_car["interval"]]
    assert [float(values["classes", "car", column]) for column in columns] == expected
    worst = scores["worst_frames"]["difference"][0]
    frame = f"largest difference frame {worst['frame']}"
    assert int(values["worst frames", frame, "B invented"]) == worst["b_invented"]
    bins = [model["by_range"][0]["mean_ap"] for model in scores["scores"]]
    assert [float(values["AP by range", f"mAP {model}", "0-10 m"]) for model in "AB"] == bins
    assert r"95 \% interval" in (tmp_path / "s.tex").read_text()


def test_a_table_is_printed_and_written() -> None:
    rows = [("*a_b & c", 2, 1 / 3, (-0.5, math.nan)), ("", "", math.nan, (0.0, 1.0))]
    table = Table("t", ("name", "boxes", "AP", "B - A"), rows, {"AP": 1}, signed=("B - A",), below="\n(50 %)")
    assert str(table).splitlines() == [
        "name      boxes   AP             B - A",
        "*a_b & c      2  0.3       -0.500 to -",
        "                   -  +0.000 to +1.000",
        "(50 %)",
    ]
    assert [row[1:] for row in table.csv_rows()][:3] == [
        ("*a_b & c", "boxes", 2),
        ("*a_b & c", "AP", 1 / 3),
        ("*a_b & c", "B - A low", -0.5),
    ]
    assert r"{*}a\_b \& c & 2 & 0.3 & -0.500 to - \\" in table.latex()
    assert table.latex().endswith("\\bottomrule\n\\end{tabular}\n\\par (50 \\%)\n")


@pytest.mark.parametrize("write", [write_csv, write_latex])
def test_a_table_replaces_tables_only(tmp_path: Path, write) -> None:
    table, path = Table("t", ("name", "AP"), [("=a", 0.5)]), tmp_path / "file"
    write([table], path)
    write([table], path)
    assert write is write_latex or "t,'=a,AP,0.5" in path.read_text()  # a spreadsheet would compute =a
    path.write_text("timestamp_ns,x,y\n")  # of a drive
    with pytest.raises(OutputError, match="is there, and is no table of scores"):
        write([table], path)
    assert path.read_text() == "timestamp_ns,x,y\n"


def test_two_tables_do_not_go_into_one_file(tmp_path: Path, tracked_files: tuple[Path, Path]) -> None:
    one = tmp_path / "one"
    with pytest.raises(InputError, match=r"--latex: .*one is the file of --csv too"):
        invoked("eval", *tracked_files, "--csv", one, "--latex", one)
