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
from bevcli.geometry.matching import descending_scores, match_greedily
from bevcli.geometry.transforms import rigid, rotation_about_z
from bevcli.workshop.scores.detection import DetectionConfig, DetectionScores, evaluate_detections, gather
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


def test_average_precision_computed_by_hand() -> None:
    # A false positive, then both cars. Precision 0, 1/2, 2/3 at recall 0, 1/2, 1, linear between them. Counted
    # are recalls 0.11 to 1.00: the sum of (p - 0.1) is 0.01 + ... + 0.40 = 8.2 up to the half,
    # and 50 * 0.4 + (0.01 + ... + 0.50) / 3 = 24.25 beyond; over 90 recalls, over 0.9.
    scores = evaluate_detections([cars([40, 0, 20], [0.9, 0.8, 0.7])], [cars([0, 20])])
    assert scores.overall.classes["car"].aps[2.0] == pytest.approx((8.2 + 24.25) / 90 / 0.9)


def test_a_match_is_closer_than_the_matching_distance() -> None:
    found = evaluate_detections([cars([1.5], [0.9])], [cars([0.0])]).overall.classes["car"].aps
    assert found == pytest.approx({0.5: 0, 1.0: 0, 2.0: 1, 4.0: 1})


def test_the_highest_score_is_matched_first() -> None:
    # The second prediction is nearer to the first car, but it is taken: it matches the other one, 1.9 m away.
    truth = gather([cars([0.0, 2.0])], np.zeros((1, 2)))
    predictions = gather([cars([0.4, 0.1], [0.9, 0.8])], np.zeros((1, 2)))
    np.testing.assert_array_equal(match_greedily(truth, predictions, (2.0, 1.0)), [[0, 1], [0, -1]])


def test_the_five_errors_computed_by_hand() -> None:
    truth = replace(cars([0.0]), velocities=np.array([[3.0, 0.0]]))
    found = replace(
        cars([0.6], [0.9]),
        centers=np.array([[0.6, 0.8, 5.0]]),  # 1 m away on the ground; height does not count
        sizes_lwh=np.array([[2.0, 2.0, 1.5]]),  # half of the length: IoU 1/2
        yaws=np.array([2 * np.pi - 0.3]),
        velocities=np.array([[3.0, 2.0]]),
        attributes=np.array(["vehicle.moving"]),
    )
    errors = evaluate_detections([found], [truth]).overall.classes["car"].errors
    expected = {"trans_err": 1.0, "scale_err": 0.5, "orient_err": 0.3, "vel_err": 2.0, "attr_err": 1.0}
    assert errors == pytest.approx(expected)


def test_a_barrier_has_no_front() -> None:
    truth, found = cars([0.0], class_name="barrier"), cars([0.0], [0.9], class_name="barrier")
    turned = replace(found, yaws=np.array([np.pi - 0.2]))
    assert evaluate_detections([turned], [truth]).overall.classes["barrier"].errors["orient_err"] == pytest.approx(0.2)
    turned_car = replace(cars([0.0], [0.9]), yaws=np.array([np.pi - 0.2]))
    errors = evaluate_detections([turned_car], [cars([0.0])]).overall.classes["car"].errors
    assert errors["orient_err"] == pytest.approx(np.pi - 0.2)


def test_perfect_predictions_score_one() -> None:
    truth = random_truth(1)
    scores = evaluate_detections(as_predictions(truth, 2), truth)
    assert scores.overall.mean_ap == pytest.approx(1)
    assert scores.overall.nd_score == pytest.approx(1)
    assert all(part.mean_recall == 1 for part in scores.by_visibility.values())


def test_no_predictions_score_zero() -> None:
    truth = random_truth(1)
    scores = evaluate_detections([Boxes3D.empty()] * len(truth), truth)
    assert scores.overall.prediction_count == 0
    assert (scores.overall.mean_ap, scores.overall.nd_score) == (0, 0)
    assert set(scores.overall.errors.values()) == {1.0}


def test_no_boxes_on_either_side_score_zero() -> None:
    scores = evaluate_detections([Boxes3D.empty()], [Boxes3D.empty()])
    assert (scores.overall.mean_ap, scores.overall.nd_score) == (0, 0)


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


@pytest.mark.parametrize("seed", range(5))
def test_matching_equals_a_plain_loop(seed: int) -> None:
    truth = random_truth(seed, per_class=8)
    predictions = as_predictions(truth, seed + 100, noise_m=1.5, false_per_frame=200)
    ego = np.zeros((len(truth), 2))
    true, found = gather(truth, ego), gather(predictions, ego)
    true, found = true[true.boxes.classes == "car"], found[found.boxes.classes == "car"]
    assert found.boxes.scores is not None
    found = found[descending_scores(found.boxes.scores)]
    for limit in (0.5, 2.0, 4.0):
        taken: set[int] = set()
        expected = []
        for frame, center in zip(found.frames, found.boxes.centers, strict=True):
            best, best_distance = -1, limit
            for place in range(len(true)):
                distance = float(np.linalg.norm(true.boxes.centers[place, :2] - center[:2]))
                if true.frames[place] == frame and place not in taken and distance < best_distance:
                    best, best_distance = place, distance
            taken.add(best)
            taken.discard(-1)
            expected.append(best)
        np.testing.assert_array_equal(match_greedily(true, found, (limit,))[0], expected)


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
