"""Masks of the segmentation head to one panoptic map, by the merging rule of Panoptic SegFormer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.frame import MAP_CLASSES, BevMap
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.transforms import Array
from bevcli.model.segmentation_head import STUFF_CLASSES, THING_CLASS, SegmentationConfig, SegmentationOutputs

# confidence = class probability ^ CLASS_POWER x mean of the mask over MASK_THRESHOLD ^ MASK_POWER, as published.
CLASS_POWER, MASK_POWER, MASK_THRESHOLD = 1, 2, 0.5


@dataclass(frozen=True)
class PanopticMap:
    """What every BEV cell is.

    stuff: (classes, rows, columns) bool in the order of STUFF_CLASSES; a crossing lies on the road, so that a cell
    may be several. things: (rows, columns) int64, the query whose vehicle stands there, -1 none. Rows from the
    smallest y.
    """

    stuff: NDArray[np.bool_]
    things: NDArray[np.int64]

    def bev_map(self, grid: BevGrid) -> BevMap:
        """The same without the identity of the vehicles, rows from the largest y."""
        layers = dict(zip(STUFF_CLASSES, self.stuff, strict=True)) | {THING_CLASS: self.things >= 0}
        cells = np.zeros(self.things.shape, dtype=np.uint8)
        for name, layer in layers.items():
            cells |= layer.astype(np.uint8) * np.uint8(MAP_CLASSES[name])
        return BevMap(cells[::-1].copy(), grid.x_range_m, grid.y_range_m)


def decode_maps(outputs: SegmentationOutputs, config: SegmentationConfig, grid: BevGrid) -> list[PanopticMap]:
    """The masks of the last layer, merged: one map a batch element.

    Masks compete for cells within their class; classes lie upon each other, as they do on the ground.
    """
    masks = outputs.mask_logits[-1].detach().float().sigmoid().unflatten(-1, (grid.rows, grid.columns))
    classes = outputs.class_logits[-1].detach().float().sigmoid()
    return [
        _panoptic_map(mask.double().cpu().numpy(), probabilities.double().cpu().numpy(), config)
        for mask, probabilities in zip(masks, classes, strict=True)
    ]


def merge(masks: Array, class_probabilities: Array, config: SegmentationConfig) -> NDArray[np.int64]:
    """Lays Q masks (Q, rows, columns), 0 to 1, down by falling confidence; a later one keeps only what is free.

    class_probabilities: (Q,). Returns (rows, columns): which mask has a cell, -1 none. A mask is dropped when it is
    not sure enough, or when too little of it remains.
    """
    merged = np.full(masks.shape[1:], -1, dtype=np.int64)
    shapes = masks > MASK_THRESHOLD
    sums, areas = (masks * shapes).sum((1, 2)), shapes.sum((1, 2))
    confidences = class_probabilities**CLASS_POWER * (sums / np.maximum(areas, 1)) ** MASK_POWER
    for index in np.argsort(-confidences, kind="stable"):
        free = shapes[index] & (merged < 0)
        if confidences[index] < config.min_confidence:
            break
        if free.any() and free.sum() >= config.min_free_share * areas[index]:
            merged[free] = index
    return merged


def _panoptic_map(masks: Array, class_probabilities: Array, config: SegmentationConfig) -> PanopticMap:
    count = len(STUFF_CLASSES)
    stuff = [merge(masks[i : i + 1], class_probabilities[i : i + 1], config) >= 0 for i in range(count)]
    return PanopticMap(np.stack(stuff), merge(masks[count:], class_probabilities[count:], config))
