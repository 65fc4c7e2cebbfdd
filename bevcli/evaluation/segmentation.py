"""IoU of BEV maps by class: what is common over what either says, in cells summed over all frames."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.frame import MAP_CLASSES, BevMap


@dataclass(frozen=True)
class SegmentationScores:
    """iou: by class, 0 to 1, NaN where neither side has a cell of it. frame_count: the maps compared."""

    iou: Mapping[str, float]
    frame_count: int


def evaluate_segmentation(
    pairs: Iterable[tuple[BevMap, BevMap]], classes: Iterable[str] = tuple(MAP_CLASSES)
) -> SegmentationScores:
    """Score (prediction, ground truth) maps of the same frames.

    A prediction of another extent or cell size is read at the middles of the ground truth's cells; cells that it
    does not reach are left out.
    """
    names = tuple(classes)
    bits = np.array([MAP_CLASSES[name] for name in names], dtype=np.uint8)
    common, either, count = np.zeros(len(names)), np.zeros(len(names)), 0
    for prediction, truth in pairs:
        found, true = _on_the_same_cells(prediction, truth)
        found_is, true_is = ((cells[:, None] & bits) > 0 for cells in (found, true))  # (cells, classes)
        common += (found_is & true_is).sum(axis=0)
        either += (found_is | true_is).sum(axis=0)
        count += 1
    iou = {name: float(c / e) if e else float("nan") for name, c, e in zip(names, common, either, strict=True)}
    return SegmentationScores(iou, count)


def _on_the_same_cells(prediction: BevMap, truth: BevMap) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Both maps' values, flat, at the ground truth's cells that the prediction reaches."""
    rows, columns = truth.cells.shape
    (x0, x1), (y0, y1) = truth.x_range_m, truth.y_range_m
    x = x0 + (np.arange(columns) + 0.5) * (x1 - x0) / columns
    y = y1 - (np.arange(rows) + 0.5) * (y1 - y0) / rows  # the first row lies farthest ahead
    (px0, px1), (py0, py1) = prediction.x_range_m, prediction.y_range_m
    column = np.floor((x - px0) / (px1 - px0) * prediction.cells.shape[1]).astype(int)
    row = np.floor((py1 - y) / (py1 - py0) * prediction.cells.shape[0]).astype(int)
    reached_columns = (column >= 0) & (column < prediction.cells.shape[1])
    reached_rows = (row >= 0) & (row < prediction.cells.shape[0])
    found = prediction.cells[np.ix_(row[reached_rows], column[reached_columns])]
    return found.ravel(), truth.cells[np.ix_(reached_rows, reached_columns)].ravel()
