"""Two models on the same frames: differences with intervals, the worst frames, and what both must have in common."""

import json
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import invoked
from made_boxes import as_predictions, made_boxes, random_truth
from sequences.nuscenes_tables import Size, write_tables
from test_eval_command import evaluated, write_frames

import bevcli
from bevcli.errors import BevcliError, InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Pose
from bevcli.sequences.files.boxes_file import BoxesWriter, FrameBoxes
from bevcli.workshop.scores.compare import draw_frames, resampled
from bevcli.workshop.scores.detection import RECALLS, evaluate_detections
from bevcli.workshop.scores.inputs import open_ground_truth

STREET = Path(__file__).parents[2] / "samples" / "street"


def cars(places: list[float], scores: list[float] | None = None) -> Boxes3D:
    """Cars on the x axis."""
    return made_boxes([(x, 0.0) for x in places], sizes_lwh=1.0, scores=scores)


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path, Path]:
    """Predictions of two models on five frames, the second the better one, and their ground truth."""
    truth = random_truth(41, frames=5, per_class=2)
    sides = {
        "a": as_predictions(truth, 42, noise_m=1.0, false_per_frame=9),
        "b": as_predictions(truth, 43, noise_m=0.3, false_per_frame=3),
        "truth": truth,
    }
    a, b, true = (write_frames(tmp_path / f"{name}.json", side, pose=Pose.identity()) for name, side in sides.items())
    return a, b, true


def test_a_resample_equals_a_data_set_with_its_frames() -> None:
    truth = random_truth(51, frames=6, per_class=2)
    found = as_predictions(truth, 52, noise_m=0.8, false_per_frame=20)
    draws = draw_frames(6, 4)
    assert (draws.sum(axis=1) == 6).all()
    assert (draws != 1).any(axis=1).all()
    for counts, table in zip(draws, resampled(evaluate_detections(found, truth), draws), strict=True):
        drawn = np.repeat(np.arange(6), counts)
        expected = evaluate_detections([found[k] for k in drawn], [truth[k] for k in drawn]).overall
        assert table.nd_score == pytest.approx(expected.nd_score, abs=1e-12)
        for name, scores in expected.classes.items():
            assert table.classes[name].aps == pytest.approx(scores.aps, abs=1e-12)
            assert table.classes[name].errors == pytest.approx(scores.errors, abs=1e-12, nan_ok=True)


def test_an_interval_is_that_of_the_binomial_distribution(tmp_path: Path) -> None:
    """Ten frames with one car each, of which A finds five and B all: AP follows from the number of found cars."""
    truth = write_frames(tmp_path / "truth.json", [cars([5.0])] * 10)
    a = write_frames(tmp_path / "a.json", [cars([5.0], [0.5])] * 5 + [cars([], [])] * 5)
    b = write_frames(tmp_path / "b.json", [cars([5.0], [0.5])] * 10)
    car = bevcli.compare(a, b, truth).classes["car"]

    def ap(found: int) -> float:
        return float((RECALLS[11:] <= found / 10).mean())

    assert car.values == pytest.approx((ap(5), 1))
    # Of 10 draws with probability 1/2: at most 1 in 1.1 % and at most 2 in 5.5 %, so 2 to 8 hold 95 %.
    assert car.interval == pytest.approx((1 - ap(8), 1 - ap(2)))
    assert car.better == "B"


def test_equal_models_have_no_difference(files: tuple[Path, Path, Path]) -> None:
    same = bevcli.compare(files[0], files[0], files[2], resamples=20)
    for each in (*same.classes.values(), same.mean_ap, same.nd_score):
        assert (each.difference, each.interval, each.better) == (0, (0, 0), "")
    assert same.worst.lists["difference"] == []


@pytest.mark.slow
def test_scores_are_those_of_two_separate_evals(files: tuple[Path, Path, Path]) -> None:
    both, alone = evaluated(*files), [evaluated(file, files[2]) for file in files[:2]]
    assert both["scores"] == alone
    assert both["mean_ap"]["values"] == [each["mean_ap"] for each in alone]
    assert both["nd_score"]["difference"] == pytest.approx(alone[1]["nd_score"] - alone[0]["nd_score"])
    assert both["mean_dist_aps"]["bus"]["values"] == [each["mean_dist_aps"]["bus"] for each in alone]
    assert (both["frames"], both["resamples"], both["confidence"]) == (5, 1000, 0.95)
    low, high = both["mean_ap"]["interval"]
    assert 0 < low < both["mean_ap"]["difference"] < high


def test_the_command_prints_what_compare_returns(files: tuple[Path, Path, Path]) -> None:
    comparison = bevcli.compare(*files, max_range=20.0, worst=2)
    options = ["--max-range", "20", "--worst", "2"]
    assert evaluated(*files, *options) == comparison.to_dict()
    shown = invoked("eval", *files, *options)
    assert shown.stdout == comparison.table() + "\n"
    assert f"B: {files[1]}" in shown.stdout
    assert "note: the intervals are too narrow for 5 frames" in shown.stderr
    assert max(map(len, shown.stdout.splitlines()[3:])) <= 115


def test_only_frames_of_both_are_compared(tmp_path: Path, files: tuple[Path, Path, Path]) -> None:
    content = json.loads(files[1].read_text())
    content["frames"] = content["frames"][:0:-1]  # the last first, without the first
    (tmp_path / "part.json").write_text(json.dumps(content))
    both = bevcli.compare(files[0], tmp_path / "part.json", files[2], resamples=50)
    assert "only the 4 frames of both are compared: A has 5, B has 4" in both.notes
    expected = bevcli.compare(files[0], files[1], files[2], resamples=1).scores[1].pairs.ground_truth[1:]
    assert [frame.stamp for frame in both.scores[0].pairs.ground_truth] == [frame.stamp for frame in expected]
    content = json.loads(files[0].read_text())
    content["frames"] = content["frames"][1:]
    (tmp_path / "rest.json").write_text(json.dumps(content))
    alone = [
        bevcli.evaluate(tmp_path / name, files[2]).detection.overall.mean_ap for name in ("rest.json", "part.json")
    ]
    assert both.mean_ap.values == pytest.approx(alone)
    every = bevcli.compare(files[0], tmp_path / "part.json", files[2], count_missing=True, resamples=50)
    assert every.scores[1].detection.frame_count == 5


def test_the_range_is_the_one_that_both_have(tmp_path: Path, files: tuple[Path, Path, Path]) -> None:
    for file, end in ((files[0], 20.0), (files[1], 12.0)):
        file.write_text(json.dumps(json.loads(file.read_text()) | {"range_m": end}))
    both = bevcli.compare(*files, resamples=5)
    assert any(note.startswith("nothing beyond 12 m is scored") for note in both.notes)
    assert not any("the model that made" in note for note in both.notes)
    alone = [bevcli.evaluate(file, files[2], 12.0).detection.overall.nd_score for file in files[:2]]
    assert both.nd_score.values == pytest.approx(alone)


@pytest.mark.parametrize("end", ["12", 0, -1.0, True, [12.0]])
def test_a_range_that_is_none_is_named(files: tuple[Path, Path, Path], end: object) -> None:
    files[0].write_text(json.dumps(json.loads(files[0].read_text()) | {"range_m": end}))
    with pytest.raises(InputError, match='"range_m" must be a distance above 0 in metres'):
        bevcli.evaluate(files[0], files[2])


def test_only_classes_of_both_are_compared(tmp_path: Path, files: tuple[Path, Path, Path]) -> None:
    """A has nuScenes' ten classes, B has cars up to 15 m, and a class of its own."""

    def stated(*classes: str) -> Path:
        content = json.loads(files[1].read_text()) | {"classes": classes}
        content["class_settings"] = {"car": {"range_m": 15.0}} if "car" in classes else {}
        (tmp_path / "own.json").write_text(json.dumps(content))
        return tmp_path / "own.json"

    own = stated("car", "tram")
    both = bevcli.compare(files[0], own, files[2], resamples=5)
    assert list(both.classes) == ["car"]
    assert both.mean_ap == both.classes["car"]
    assert both.scores[0].detection.config.class_ranges_m == {"car": 15.0}
    assert any(note.startswith("only classes of both are compared, without truck") for note in both.notes)
    with pytest.raises(InputError, match="the two models have no class in common"):
        bevcli.compare(files[0], stated("tram"), files[2])


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """The sample drive with one car in each of its first four frames."""
    folder = tmp_path / "a drive"
    shutil.copytree(STREET, folder, ignore=shutil.ignore_patterns("images", "ground_truth*"))
    write_frames(folder / "ground_truth.json", [cars([5.0])] * 4)
    return folder


@pytest.fixture
def found(tmp_path: Path) -> Path:
    """Nothing missed, one missed, two invented, one missed and one invented."""
    frames = [([5.0], [0.9]), ([], []), ([5.0, 9.0, 13.0], [0.9, 0.8, 0.8]), ([17.0], [0.85])]
    sure = ([5.0], [0.7])  # so that the best F1 keeps the invented ones
    return write_frames(tmp_path / "found.json", [cars(*each) for each in (*frames, sure, sure, sure)])


def test_the_worst_frames_are_named(tmp_path: Path, drive: Path, found: Path) -> None:
    write_frames(drive / "ground_truth.json", [cars([5.0])] * 7)
    assert "worst_frames" not in evaluated(found, drive)
    worst = evaluated(found, drive, "--worst", "1")["worst_frames"]
    [missed], [invented] = worst["missed"], worst["invented"]
    assert {key: missed[key] for key in ("frame", "scene", "missed", "invented", "ground_truth_boxes")} == {
        "frame": 1, "scene": "s", "missed": 1, "invented": 0, "ground_truth_boxes": 1,
    }  # fmt: skip
    assert (invented["frame"], invented["missed"], invented["invented"]) == (2, 0, 2)
    assert shlex.split(worst["view"]) == ["bevcli", "viz", str(drive), "--boxes", str(found), "--frame", "1"]
    scores = bevcli.evaluate(found, drive, worst=5)
    assert scores.worst.lists == {"missed": [1, 3], "invented": [2, 3]}
    assert scores.table().endswith(f"Look at it: {worst['view']}")


def test_frames_where_two_models_differ_most_come_first(tmp_path: Path, drive: Path, found: Path) -> None:
    write_frames(drive / "ground_truth.json", [cars([5.0])] * 7)
    right = write_frames(tmp_path / "right.json", [cars([5.0], [0.9])] * 7)
    worst = bevcli.compare(found, right, drive, resamples=5).to_dict()["worst_frames"]
    assert [each["frame"] for each in worst["difference"]] == [2, 3, 1]
    assert {key: worst["difference"][0][key] for key in ("a_missed", "a_invented", "b_missed", "b_invented")} == {
        "a_missed": 0, "a_invented": 2, "b_missed": 0, "b_invented": 0,
    }  # fmt: skip
    assert worst["b_missed"] == worst["b_invented"] == []
    words = ["--boxes", str(found), "--boxes", str(right), "--frame", "2"]
    assert shlex.split(worst["view"]) == ["bevcli", "viz", str(drive), *words]


def test_frames_of_several_scenes_have_the_name_of_theirs(tmp_path: Path) -> None:
    for name, boxes in (("truth", cars([5.0])), ("found", cars([25.0], [0.5]))):
        with BoxesWriter(tmp_path / f"{name}.json", "ego") as writer:
            for place, scene in enumerate(("left", "right")):
                writer.write(FrameBoxes(FrameStamp(place, scene, place * 500_000_000), None, boxes))
    scores = bevcli.evaluate(tmp_path / "found.json", tmp_path / "truth.json", worst=1)
    assert "most missed   left frame 0 " in scores.table()
    assert scores.to_dict()["worst_frames"]["view"] is None  # the ground truth belongs to no drive
    assert "Look at it" not in scores.table()


def test_a_frame_of_a_nuscenes_root_is_seen_in_its_scene(tmp_path: Path) -> None:
    """The fifth frame of two scenes with three each is the second of the second scene."""
    root, found = tmp_path / "root", tmp_path / "found.json"
    write_tables(root / "v1.0-mini", Size(scenes=2, samples=3, objects=2))
    table = root / "v1.0-mini" / "sample_annotation.json"
    rows = json.loads(table.read_text())
    for row in rows:
        row["translation"][1] += 2000  # to the vehicle
    table.write_text(json.dumps(rows))
    frames = open_ground_truth(root).boxes.frames
    with BoxesWriter(found, "world") as writer:
        for place, frame in enumerate(frames):
            all_found = replace(frame.boxes, scores=np.ones(len(frame.boxes)))
            writer.write(replace(frame, boxes=all_found[:0] if place == 4 else all_found))
    view = evaluated(found, root, "--worst", "1")["worst_frames"]["view"]
    assert view.endswith("--scene scene-0002 --frame 1")
    stamps = bevcli.open_sequence(root, scene="scene-0002").stamps
    assert (stamps[1].index, stamps[1].timestamp_ns) == (1, frames[4].stamp.timestamp_ns)
    of_scene = evaluated(found, root, "--worst", "1", "--scene", "scene-0002")["worst_frames"]["view"]
    assert of_scene == view


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"resamples": 0}, "`resamples` is 0"),
        (
            {"tracking": True},
            r"`tracking=True` \(`--tracking`\): two files of predictions are compared by their boxes only",
        ),
        ({"max_range": -1.0}, "the largest range is not positive"),
    ],
)
def test_what_cannot_be_compared_is_named(files: tuple[Path, Path, Path], change: dict[str, Any], message: str) -> None:
    with pytest.raises(BevcliError, match=message):
        bevcli.compare(*files, **change)


def test_a_third_file_and_models_without_a_common_frame_are_refused(files: tuple[Path, Path, Path]) -> None:
    with pytest.raises(InputError, match=r"found 3 files of predictions .expected 1, or 2 to compare"):
        invoked("eval", *files[:2], *files[1:])
    for place, file in enumerate(files[:2]):
        content = json.loads(file.read_text())
        file.write_text(json.dumps(content | {"frames": content["frames"][2 * place : 2 * place + 2]}))
    with pytest.raises(InputError, match="have no frame of the ground truth in common"):
        bevcli.compare(*files)


@pytest.mark.slow
def test_the_commands_of_the_page_run(tmp_path: Path, drive: Path, found: Path, monkeypatch: Any) -> None:
    page = (STREET.parents[1] / "docs" / "compare.md").read_text().partition("## Compare two models")[2]
    (tmp_path / "samples").mkdir()
    drive.rename(tmp_path / "samples" / "street")
    found.rename(tmp_path / "mine.json")
    write_frames(tmp_path / "other.json", [cars([5.0], [0.9])] * 4)
    monkeypatch.chdir(tmp_path)
    both, one = re.findall("^bevcli eval .*$", page, flags=re.MULTILINE)
    shown = invoked(*shlex.split(both, comments=True)[1:])
    [view] = re.findall("^Look at it: .*--frame ", page, flags=re.MULTILINE)
    for text in (view, "better\n", "A missed  A invented  B missed  B invented\n"):
        assert text in page
        assert text in shown.stdout
    assert re.search(r"^AP by range +0-10 m .*\ncar +A +\d\.\d{3} .*\ncar +B ", shown.stdout, flags=re.MULTILINE)
    assert {path.name for path in Path("plots").iterdir()} == {
        "precision_recall_of_both.png",
        "errors_by_range_of_both.png",
        *(f"misses_and_false_alarms_{model}.png" for model in "AB"),
    }
    alone = both.replace("--plot plots", "--plot curves.svg")
    invoked(*shlex.split(alone, comments=True)[1:])
    assert "<svg" in Path("curves.svg").read_text()[:1000]
    image = cv2.imread("plots/precision_recall_of_both.png")
    assert image is not None
    blue, red = image[..., 0].astype(int), image[..., 2].astype(int)
    assert (blue - red > 60).sum() > 500  # the curves of A
    assert (red - blue > 60).sum() > 500
    shown = invoked(*shlex.split(one, comments=True)[1:])
    assert "worst frames" in shown.stdout
