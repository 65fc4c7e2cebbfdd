"""Map folders are read back; IoU of maps by hand; joint scores of drives equal those of all their frames together."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from random_boxes import as_predictions, random_truth

from bevcli.errors import InputError
from bevcli.frame import BevMap
from bevcli.geometry.boxes import Boxes3D
from bevcli.runs.state import load_state, save_state
from bevcli.sequences.files.map_folder import open_maps, write_map
from bevcli.workshop.batch.report import DriveMatches, score_jointly
from bevcli.workshop.scores.detection import DetectionConfig, evaluate_detections
from bevcli.workshop.scores.evaluate import FrameScores, evaluate_segmentation

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
