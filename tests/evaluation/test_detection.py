"""Detection scores: numbers computed by hand, properties that hold for any boxes, and those of the nuScenes devkit.

tests/data/detection_metrics.json holds synthetic boxes and the scores that devkit 1.2.0 computed for them with the
configuration detection_cvpr_2019.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_boxes import made_boxes
from random_boxes import as_predictions, random_truth

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import rigid, rotation_about_z
from bevcli.workshop.scores.detection import DetectionConfig, DetectionScores, evaluate_detections
from bevcli.workshop.scores.evaluate import evaluate


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
