"""What counts as found, missed and false."""

from dataclasses import replace

import numpy as np

from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.recording.matching import counted, match


def boxes(places, classes, scores=None) -> Boxes3D:
    count = len(places)
    centers = np.column_stack([np.array(places, dtype=float), np.zeros(count)])
    score_array = None if scores is None else np.array(scores)
    return Boxes3D(centers, np.ones((count, 3)), np.zeros(count), np.zeros((count, 2)), np.array(classes), score_array)


def test_a_box_is_found_within_two_metres_and_its_class():
    truth = boxes([(0, 0), (10, 0), (20, 0)], ["car", "car", "bus"])
    predicted = boxes([(0, 1.9), (10, 2.1), (20, 0)], ["car", "car", "car"], [0.9, 0.8, 0.7])
    true, found = match(predicted, truth)
    assert true.tolist() == [True, False, False]
    assert found.tolist() == [True, False, False]


def test_one_box_is_found_once_by_the_best():
    truth = boxes([(0, 0)], ["car"])
    true, found = match(boxes([(0.1, 0), (0.5, 0)], ["car", "car"], [0.3, 0.9]), truth)
    assert true.tolist() == [False, True]
    assert found.tolist() == [True]


def test_nothing_is_missed_that_nobody_could_see():
    truth = replace(boxes([(0, 0), (1, 1), (80, 0)], ["car"] * 3), num_points=np.array([5, 0, 5]))
    assert counted(truth, BevGrid(50, 50)).centers[:, 0].tolist() == [0]
