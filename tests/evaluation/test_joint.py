"""Joint scores of drives equal the scores of all their frames together."""

from dataclasses import replace

import numpy as np
import pytest
from random_boxes import as_predictions, random_truth

from bevcli.frame import BevMap
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.matching import DetectionConfig
from bevcli.runs.state import load_state, save_state
from bevcli.workshop.batch.report import DriveMatches, score_jointly
from bevcli.workshop.scores.detection import evaluate_detections
from bevcli.workshop.scores.evaluate import FrameScores, evaluate_segmentation

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


def test_joint_scores_equal_those_of_all_frames_together():
    drives = [drive_of(1, 4, 0.3), drive_of(2, 7, 1.5), drive_of(3, 2, 0.8)]
    truth, predictions = ([frame for drive in drives for frame in drive[side]] for side in range(2))
    joint = score_jointly([matches_of(*drive) for drive in drives], CONFIG)
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


def test_matches_of_a_drive_are_the_same_after_a_file(tmp_path):
    before = matches_of(*drive_of(4, 3, 0.5))
    save_state(tmp_path / "matches.pt", before)
    after = load_state(tmp_path / "matches.pt", DriveMatches)
    assert_same(score_jointly([after], CONFIG).detection, score_jointly([before], CONFIG).detection)


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
