"""IoU of BEV maps by class: intersection over union in cells, each summed over all frames."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.frame import MAP_CLASSES, BevMap


@dataclass(frozen=True)
class SegmentationScores:
    """The scores of maps.

    Attributes:
        intersection: by class, cells that have the class in prediction and ground truth, over all maps.
        union: by class, cells that have it in prediction or ground truth, over all maps.
        frame_count: number of pairs of maps.
    """

    intersection: Mapping[str, float]
    union: Mapping[str, float]
    frame_count: int

    @property
    def iou(self) -> dict[str, float]:
        """By class, 0 to 1; NaN where neither predictions nor ground truth have the class."""
        return {name: self.intersection[name] / union if union else math.nan for name, union in self.union.items()}


def evaluate_segmentation(
    pairs: Iterable[tuple[BevMap, BevMap]], classes: Iterable[str] = tuple(MAP_CLASSES)
) -> SegmentationScores:
    """Score pairs of maps (prediction, ground truth), one pair a frame.

    Classes are compared by name; they may have different bits in the two maps. A prediction with another extent or cell
    size is sampled at the centres of the ground truth's cells; cells outside its extent are left out.
    """
    names = tuple(classes)
    intersection, union, count = np.zeros(len(names)), np.zeros(len(names)), 0
    for prediction, truth in pairs:
        predicted, true = _at_ground_truth_cells(prediction, truth)
        bits = [np.array([bev_map.classes.get(name, 0) for name in names], np.uint8) for bev_map in (prediction, truth)]
        predicted_is, true_is = (predicted[:, None] & bits[0]) > 0, (true[:, None] & bits[1]) > 0  # (cells, classes)
        intersection += (predicted_is & true_is).sum(axis=0)
        union += (predicted_is | true_is).sum(axis=0)
        count += 1
    both, either = (dict(zip(names, counts.tolist(), strict=True)) for counts in (intersection, union))
    return SegmentationScores(both, either, count)


def _at_ground_truth_cells(prediction: BevMap, truth: BevMap) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Both maps' values at the ground truth's cells inside the prediction's extent, each (M,)."""
    rows, columns = truth.cells.shape
    (x0, x1), (y0, y1) = truth.x_range_m, truth.y_range_m
    x = x0 + (np.arange(columns) + 0.5) * (x1 - x0) / columns
    y = y1 - (np.arange(rows) + 0.5) * (y1 - y0) / rows  # the first row has the largest y
    (px0, px1), (py0, py1) = prediction.x_range_m, prediction.y_range_m
    column = np.floor((x - px0) / (px1 - px0) * prediction.cells.shape[1]).astype(int)
    row = np.floor((py1 - y) / (py1 - py0) * prediction.cells.shape[0]).astype(int)
    columns_inside = (column >= 0) & (column < prediction.cells.shape[1])
    rows_inside = (row >= 0) & (row < prediction.cells.shape[0])
    predicted = prediction.cells[np.ix_(row[rows_inside], column[columns_inside])]
    return predicted.ravel(), truth.cells[np.ix_(rows_inside, columns_inside)].ravel()
