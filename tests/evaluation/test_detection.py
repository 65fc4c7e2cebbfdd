"""Detection scores by hand, for any boxes, and of the nuScenes devkit; map folders and IoU of maps; joint scores.

tests/data/detection_metrics.json holds synthetic boxes and the scores that devkit 1.2.0 computed for them with the
configuration detection_cvpr_2019.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from made_boxes import as_predictions, made_boxes, random_truth

from bevcli.errors import InputError
from bevcli.frame import BevMap
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import rigid, rotation_about_z
from bevcli.runs.state import load_state, save_state
from bevcli.sequences.files.map_folder import open_maps, write_map
from bevcli.workshop.batch.report import DriveMatches, score_jointly
from bevcli.workshop.scores.detection import DetectionConfig, DetectionScores, evaluate_detections
from bevcli.workshop.scores.evaluate import FrameScores, evaluate, evaluate_segmentation


def cars(x: list[float], scores: list[float] | None = None, class_name: str = "car") -> Boxes3D:
    return made_boxes([(each, 0.0) for each in x], class_name, scores=scores, attributes="vehicle.parked")


def numbers(scores: DetectionScores) -> dict[str, float]:
    """Every number of the overall table."""
    table = scores.overall
    found = {"mean_ap": table.mean_ap, "nd_score": table.nd_score, **table.errors}
    for name, of_class in table.classes.items():
        found |= {f"{name} {distance}": ap for distance, ap in of_class.aps.items()}
        found |= {f"{name} {error}": value for error, value in of_class.errors.items()}
    return found


def test_perfect_predictions_score_one() -> None:
    truth = random_truth(1)
    scores = evaluate_detections(as_predictions(truth, 2), truth)
    assert scores.overall.mean_ap == pytest.approx(1)
    assert scores.overall.nd_score == pytest.approx(1)
    assert all(part.mean_recall == 1 for part in scores.by_visibility.values())


def test_the_order_of_boxes_and_frames_does_not_matter() -> None:
    truth = random_truth(3)
    predictions = as_predictions(truth, 4, noise_m=0.7, false_per_frame=30)
    rng = np.random.default_rng(5)
    order = rng.permutation(len(truth))
    shuffled = evaluate_detections(
        [predictions[place][rng.permutation(len(predictions[place]))] for place in order],
        [truth[place][rng.permutation(len(truth[place]))] for place in order],
    )
    assert numbers(shuffled) == pytest.approx(numbers(evaluate_detections(predictions, truth)), nan_ok=True)


def test_a_rigid_motion_of_the_world_changes_nothing() -> None:
    truth = random_truth(6)
    predictions = as_predictions(truth, 7, noise_m=0.7, false_per_frame=30)
    motions = [rigid((1000.0 * k, -500.0, 7.0), rotation_about_z(0.7 * k)) for k in range(1, len(truth) + 1)]
    moved = evaluate_detections(
        [boxes.transformed(motion) for boxes, motion in zip(predictions, motions, strict=True)],
        [boxes.transformed(motion) for boxes, motion in zip(truth, motions, strict=True)],
        ego_xy=np.array([motion[:2, 3] for motion in motions]),
    )
    assert numbers(moved) == pytest.approx(numbers(evaluate_detections(predictions, truth)), nan_ok=True)


def test_what_is_beyond_the_range_of_its_class_does_not_count() -> None:
    near = evaluate_detections([cars([0], [0.5])], [cars([0])])
    both = evaluate_detections([cars([0, 51], [0.5, 0.9])], [cars([0, 60])])
    assert numbers(both) == pytest.approx(numbers(near), nan_ok=True)
    cut = evaluate_detections([cars([0, 35], [0.5, 0.9])], [cars([0, 40])], DetectionConfig().cut_at(32))
    assert numbers(cut) == pytest.approx(numbers(near), nan_ok=True)
    unlimited = evaluate_detections([cars([0, 51], [0.5, 0.9])], [cars([0])], DetectionConfig().unlimited())
    assert unlimited.overall.prediction_count == 2


def test_ground_truth_without_points_is_left_out() -> None:
    truth = replace(cars([0, 20, 30]), num_points=np.array([3, 0, -1]))
    scores = evaluate_detections([cars([0], [0.5])], [truth])
    assert scores.overall.ground_truth_count == 2


def test_an_error_without_ground_truth_is_left_out_of_nds() -> None:
    truth = random_truth(1)
    untold = [replace(boxes, attributes=None, velocities=np.full((len(boxes), 2), np.nan)) for boxes in truth]
    scores = evaluate_detections(as_predictions(truth, 2), untold)
    assert scores.unmeasured == ("vel_err", "attr_err")
    assert np.isnan(scores.overall.errors["vel_err"])
    assert scores.overall.nd_score == pytest.approx(1)


def test_each_box_counts_in_one_range_bin() -> None:
    truth = random_truth(8)
    scores = evaluate_detections(as_predictions(truth, 9, noise_m=0.5, false_per_frame=20), truth)
    counts = [sum(c.ground_truth_count for c in part.classes.values()) for part in scores.by_range.values()]
    assert sum(counts) == scores.overall.ground_truth_count
    found = sum(c.recall * c.ground_truth_count for part in scores.by_range.values() for c in part.classes.values())
    assert found == pytest.approx(
        sum(c.recall * c.ground_truth_count for c in scores.overall.classes.values() if c.ground_truth_count)
    )


def test_a_pair_across_the_border_of_bins_is_not_split() -> None:
    scores = evaluate_detections([cars([10.4], [0.9])], [cars([9.6])])
    bins = {low: table for (low, _), table in scores.by_range.items()}
    assert bins[0].classes["car"].aps[1.0] == pytest.approx(1)
    assert not bins[10].classes


def test_recall_by_visibility_counts_at_two_metres() -> None:
    truth = replace(cars([0, 10, 20, 30, 40]), visibilities=np.array([0.1, 0.39, 0.4, 1.0, np.nan]))
    scores = evaluate_detections([cars([1.9, 22.1, 30], [0.9, 0.8, 0.1])], [truth])
    found = {low: (part.prediction_count, part.ground_truth_count) for (low, _), part in scores.by_visibility.items()}
    assert found == {0.0: (1, 2), 0.4: (0, 1), 0.6: (0, 0), 0.8: (1, 1)}
    assert evaluate_detections([cars([0], [0.9])], [cars([0])]).by_visibility == {}


GOLDEN = json.loads((Path(__file__).parents[1] / "data" / "detection_metrics.json").read_text())
TOLERANCE = 1e-9  # docs/scoring.md and README.md state it


def test_every_number_of_evaluated_files_equals_the_devkits(tmp_path: Path) -> None:
    for side in ("predictions", "ground_truth"):
        frames: list[dict[str, Any]] = [
            {"frame": place, "timestamp_ns": place * 500_000_000, "boxes": []} for place in range(12)
        ]
        for row in GOLDEN[side]:
            kept = {key: value for key, value in row.items() if key != "sample" and value != -1.0}
            frames[int(row["sample"].removeprefix("sample-"))]["boxes"].append(kept)
        content = {"format": "bevcli-boxes/1", "frame_of_reference": "ego", "frames": frames}
        (tmp_path / f"{side}.json").write_text(json.dumps(content))
    scores = evaluate(tmp_path / "predictions.json", tmp_path / "ground_truth.json").to_dict()
    for key, expected in GOLDEN["expected"].items():
        if isinstance(expected, float):
            assert scores[key] == pytest.approx(expected, abs=TOLERANCE)
        else:
            for name, value in expected.items():
                assert scores[key][name] == pytest.approx(value, abs=TOLERANCE, nan_ok=True), (key, name)


MAP = BevMap(np.arange(12, dtype=np.uint8).reshape(3, 4), (-32.0, 32.0), (-24.0, 24.0))


@pytest.mark.parametrize("classes", [MAP.classes, {"line": 16, "road": 2}])
def test_what_is_written_is_read_back(tmp_path: Path, classes: dict[str, int]) -> None:
    write_map(tmp_path / "maps", 7, replace(MAP, cells=MAP.cells & sum(classes.values()), classes=classes))
    folder = open_maps(tmp_path / "maps")
    assert (folder.has(7), folder.has(8)) == (True, False)
    assert list(folder.classes.items()) == sorted(classes.items(), key=lambda item: item[1])
    found = folder.load(7)
    assert (found.x_range_m, found.y_range_m) == (MAP.x_range_m, MAP.y_range_m)
    for name, bit in classes.items():
        np.testing.assert_array_equal(found.layer(name), MAP.cells & bit > 0)
    assert not found.layer("none").any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"x_range_m": (-50.0, 50.0)}, ""), ({"classes": {"line": 1}}, "states .*drivable_road.*, but .* has .*'line'.*")],
)
def test_maps_of_another_extent_or_of_other_classes_do_not_mix(tmp_path: Path, changes: dict, message: str) -> None:
    write_map(tmp_path, 0, MAP)
    with pytest.raises(InputError, match=f"{message}: write it to another folder"):
        write_map(tmp_path, 1, replace(MAP, **changes))
    assert not open_maps(tmp_path).has(1)


def test_a_missing_or_wrong_image_is_named(tmp_path: Path) -> None:
    write_map(tmp_path, 0, MAP)
    folder = open_maps(tmp_path)
    with pytest.raises(InputError, match=r"000001\.png: the map of frame 1 is missing"):
        folder.load(1)
    cv2.imwrite(str(tmp_path / "000002.png"), np.zeros((3, 4, 3), np.uint8))
    with pytest.raises(InputError, match=r"000002\.png: expected an 8-bit image with one channel"):
        folder.load(2)
    cv2.imwrite(str(tmp_path / "000003.png"), np.full((3, 4), 16, np.uint8))
    with pytest.raises(InputError, match="bits 0x10 belong to no class"):
        folder.load(3)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("format", "map", '"format" must be "bevcli-map/1"'),
        ("x_range_m", [3, 1], '"x_range_m" must be two numbers'),
        ("y_range_m", None, '"y_range_m" must be two numbers'),
        ("classes", {"3": "drivable_road"}, '"classes" must name bits'),
        ("classes", {"256": "drivable_road"}, '"classes" must name bits'),
        ("classes", {"1": "road", "2": "road"}, '"classes" must name bits'),
        ("classes", {"1": ""}, '"classes" must name bits'),
        ("classes", {"1": "road\x1b[2J"}, '"classes" must name bits'),
        ("classes", {"1": ["road"]}, '"classes" must name bits'),
        ("classes", {}, '"classes" must name bits'),
    ],
)
def test_a_wrong_legend_is_named(tmp_path: Path, key: str, value: object, message: str) -> None:
    write_map(tmp_path, 0, MAP)
    legend = json.loads((tmp_path / "map.json").read_text())
    (tmp_path / "map.json").write_text(json.dumps({**legend, key: value}))
    with pytest.raises(InputError, match=message):
        open_maps(tmp_path)


RANGES = ((-2.0, 2.0), (-2.0, 2.0))


def bev_map(cells: list[list[int]], ranges: tuple[tuple[float, float], tuple[float, float]] = RANGES) -> BevMap:
    return BevMap(np.array(cells, dtype=np.uint8), *ranges)


def test_a_cell_may_be_several_classes() -> None:
    found = bev_map([[1, 9], [0, 8]])
    true = bev_map([[1, 1], [1, 8]])
    scores = evaluate_segmentation([(found, true)])
    assert scores.iou["drivable_road"] == pytest.approx(2 / 3)
    assert scores.iou["vehicle"] == pytest.approx(1 / 2)
    assert np.isnan(scores.iou["lane_boundary"])


def test_classes_are_compared_by_name() -> None:
    found = BevMap(np.array([[1, 2], [3, 0]], np.uint8), *RANGES, {"drivable_area": 1, "pedestrian_crossing": 2})
    true = bev_map([[0, 4], [4, 4]])
    scores = evaluate_segmentation([(found, true)], ["pedestrian_crossing"])
    assert scores.iou == pytest.approx({"pedestrian_crossing": 2 / 3})


def test_cells_are_summed_over_frames() -> None:
    empty, full = bev_map([[0, 0], [0, 0]]), bev_map([[8, 8], [8, 8]])
    one = bev_map([[8, 0], [0, 0]])
    scores = evaluate_segmentation([(one, full), (full, full), (empty, empty)], ["vehicle"])
    assert scores.frame_count == 3
    assert scores.iou == pytest.approx({"vehicle": 5 / 8})  # not the mean of 1/4 and 1


def test_a_finer_wider_prediction_is_sampled_at_cells_of_truth() -> None:
    true = bev_map([[1, 0], [0, 2]])
    wide = np.zeros((8, 8), dtype=np.uint8)  # cells of 1 m over 8 m
    wide[2:4, 2:4], wide[4:6, 4:6], wide[0], wide[7] = 1, 2, 8, 8
    scores = evaluate_segmentation([(BevMap(wide, (-4.0, 4.0), (-4.0, 4.0)), true)])
    assert scores.iou["drivable_road"] == 1
    assert scores.iou["lane_boundary"] == 1
    assert np.isnan(scores.iou["vehicle"])  # lies outside the truth


def test_cells_outside_the_prediction_are_left_out() -> None:
    true = bev_map([[1, 1], [1, 1]])
    ahead_only = bev_map([[1, 1]], ((-2.0, 2.0), (0.0, 2.0)))
    assert evaluate_segmentation([(ahead_only, true)]).iou["drivable_road"] == 1


CONFIG = DetectionConfig().cut_at(25)


def drive_of(seed, frames, noise_m):
    """Ground truth and predictions; their scores have one digit, so that many are equal."""
    truth = random_truth(seed, frames)
    predictions = as_predictions(truth, seed, noise_m, false_per_frame=5)
    return truth, [replace(boxes, scores=np.round(boxes.scores, 1)) for boxes in predictions]


def matches_of(truth, predictions):
    found = evaluate_detections(predictions, truth, CONFIG)
    return DriveMatches(found.frame_count, found.matches, found.unmeasured, None)


def assert_same(one, other):
    one, other = (FrameScores(scores).to_dict() for scores in (one, other))
    assert one["frames"] == other["frames"]
    for key in ("mean_ap", "nd_score", "tp_errors", "label_aps", "label_tp_errors", "label_recalls", "by_range"):
        assert flat(one[key]) == pytest.approx(flat(other[key]), nan_ok=True), key
    assert one["recall_by_visibility"] == other["recall_by_visibility"]


def flat(value):
    if isinstance(value, dict):
        return [number for entry in value.values() for number in flat(entry)]
    if isinstance(value, list):
        return [number for entry in value for number in flat(entry)]
    return [np.nan if value is None else value]


def test_joint_scores_equal_those_of_all_frames_together(tmp_path):
    """Also where matches of a drive were kept in a file."""
    drives = [drive_of(1, 4, 0.3), drive_of(2, 7, 1.5), drive_of(3, 2, 0.8)]
    truth, predictions = ([frame for drive in drives for frame in drive[side]] for side in range(2))
    matches = [matches_of(*drive) for drive in drives]
    save_state(tmp_path / "matches.pt", matches[0])
    joint = score_jointly([load_state(tmp_path / "matches.pt", DriveMatches), *matches[1:]], CONFIG)
    assert_same(joint.detection, evaluate_detections(predictions, truth, CONFIG))
    assert joint.segmentation is None
    means = np.mean([evaluate_detections(p, t, CONFIG).overall.mean_ap for t, p in drives])
    assert abs(joint.detection.overall.mean_ap - means) > 0.01  # which is not the mean of the drives


def test_drives_without_boxes_on_one_side_count_too():
    truth, predictions = drive_of(1, 3, 0.3)
    empty = [Boxes3D.empty()] * 3
    unseen = [replace(Boxes3D.empty(), scores=np.zeros(0))] * 3
    drives = [(truth, predictions), (empty, predictions), (truth, unseen)]
    joint = score_jointly([matches_of(*drive) for drive in drives], CONFIG)
    assert_same(
        joint.detection, evaluate_detections([*predictions, *predictions, *unseen], [*truth, *empty, *truth], CONFIG)
    )


def test_joint_iou_sums_cells():
    def map_of(cells):
        return BevMap(np.array(cells, dtype=np.uint8), (0.0, 2.0), (0.0, 1.0))

    one = evaluate_segmentation([(map_of([[1, 1]]), map_of([[1, 0]]))])  # road: 1 of 2 cells
    other = evaluate_segmentation([(map_of([[1, 1]]), map_of([[1, 1]]))] * 3)  # road: 6 of 6 cells
    drives = [replace(matches_of(*drive_of(1, 1, 0.1)), segmentation=maps) for maps in (one, other, None)]
    maps = score_jointly(drives, CONFIG).segmentation
    assert maps.iou["drivable_road"] == 7 / 8
    assert np.isnan(maps.iou["vehicle"])
    assert maps.frame_count == 4
