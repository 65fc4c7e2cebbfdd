"""IoU of maps, computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from bevcli.frame import BevMap
from bevcli.workshop.scores.evaluate import evaluate_segmentation

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
