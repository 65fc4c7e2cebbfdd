"""True positives and missed ground truth in the display are those of `bevcli eval`."""

from dataclasses import replace

import numpy as np
import pytest

from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.recording.entities import GROUND_TRUTH_COLOR, MISSED_COLOR, OTHER_COLOR
from bevcli.recording.log_boxes import detectable, ground_truth_colors, other_classes, true_positives
from bevcli.workshop.scores.detection import DetectionConfig, evaluate_detections


def boxes(places, classes, scores=None) -> Boxes3D:
    count = len(places)
    centers = np.column_stack([np.array(places, dtype=float), np.zeros(count)])
    score_array = None if scores is None else np.array(scores)
    return Boxes3D(centers, np.ones((count, 3)), np.zeros(count), np.zeros((count, 2)), np.array(classes), score_array)


def test_truth_outside_grid_or_without_points_is_undetectable():
    truth = replace(boxes([(0, 0), (1, 1), (80, 0)], ["car"] * 3), num_points=np.array([5, 0, 5]))
    assert detectable(truth, BevGrid(50, 50)).centers[:, 0].tolist() == [0]


def evaluated(predicted, truth):
    """As `true_positives`, from the matching of the evaluation at 2 m."""
    scores = evaluate_detections([predicted], [truth], DetectionConfig().unlimited())
    centers = {"truth": [], "predicted": []}
    row = DetectionConfig().distances_m.index(2.0)
    for part in scores.matches:
        centers["predicted"] += part.predictions.boxes.centers[part.matched[row] >= 0].tolist()
        centers["truth"] += part.ground_truth.boxes.centers[part.matched[row][part.matched[row] >= 0]].tolist()
    return (
        [center in centers["predicted"] for center in predicted.centers.tolist()],
        [center in centers["truth"] for center in truth.centers.tolist()],
    )


@pytest.mark.parametrize(
    ("truth", "predicted", "true", "found"),
    [
        (  # within two metres, and its class
            boxes([(0, 0), (10, 0), (20, 0)], ["car", "car", "bus"]),
            boxes([(0, 1.9), (10, 2.1), (20, 0)], ["car"] * 3, [0.9, 0.8, 0.7]),
            [True, False, False], [True, False, False],
        ),
        (boxes([(0, 0)], ["car"]), boxes([(0.1, 0), (0.5, 0)], ["car"] * 2, [0.3, 0.9]), [False, True], [True]),
        (  # at exactly two metres
            boxes([(0, 0), (10, 0)], ["car"] * 2),
            boxes([(0, 2.0), (10, np.nextafter(2.0, 0))], ["car"] * 2, [0.9, 0.8]),
            [False, True], [False, True],
        ),
        # Of equal scores the later one, as in the devkit.
        (boxes([(0, 0)], ["car"]), boxes([(0.1, 0), (0.5, 0)], ["car"] * 2, [0.7, 0.7]), [False, True], [True]),
    ],
)  # fmt: skip
def test_boxes_are_found_as_the_evaluation_does(truth, predicted, true, found):
    assert [part.tolist() for part in true_positives(predicted, truth)] == [true, found]
    assert evaluated(predicted, truth) == (true, found)


@pytest.mark.parametrize("seed", range(20))
def test_the_display_agrees_with_the_evaluation(seed):
    rng = np.random.default_rng(seed)
    names = np.array(["car", "bus", "pedestrian"])
    places = [rng.integers(0, 8, (count, 2)) + rng.uniform(0, 1e-6, (count, 2)) for count in (25, 60)]
    truth = boxes(places[0], rng.choice(names, 25))
    predicted = boxes(places[1], rng.choice(names, 60), rng.integers(1, 5, 60) / 5)
    true, found = true_positives(predicted, truth)
    assert true.any()
    assert not true.all()
    assert evaluated(predicted, truth) == (true.tolist(), found.tolist())


def test_ground_truth_of_other_classes_is_grey_and_never_missed():
    truth = boxes([(0, 0), (5, 0), (9, 0)], ["car", "Tricycle", "bus"])
    other = other_classes(truth, ("car", "bus"))
    assert other.tolist() == [False, True, False]
    assert not other_classes(truth, ("car", "bus", "Tricycle")).any()
    colors = ground_truth_colors(np.array([True, True, False]), other)
    assert colors.tolist() == [list(GROUND_TRUTH_COLOR), list(OTHER_COLOR), list(MISSED_COLOR)]
