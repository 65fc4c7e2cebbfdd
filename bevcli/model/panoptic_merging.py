"""Masks of the segmentation head to one panoptic map: a cell is of the query that most probably has it.

The probability is that of the query's class times the mask's value (MaskFormer, Cheng et al. 2021). Panoptic
SegFormer lays whole masks down instead, those over 0.5; focal loss makes masks that seldom say so much of a small
vehicle, and on rendered drives that rule loses a sixth of the vehicles' IoU.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from bevcli.frame import MAP_CLASSES, BevMap
from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.segmentation_head import STUFF_CLASSES, THING_CLASS, SegmentationConfig, SegmentationOutputs


@dataclass(frozen=True)
class PanopticMap:
    """What every cell is; rows from the smallest y.

    stuff: (classes, rows, columns) bool in the order of STUFF_CLASSES; a crossing lies on the road, so that a cell
    may be several. things: (rows, columns) int64, the query whose vehicle stands there, -1 none.
    """

    stuff: NDArray[np.bool_]
    things: NDArray[np.int64]

    def bev_map(self, grid: BevGrid) -> BevMap:
        """The same without the identity of the vehicles, rows from the largest y. grid: says how far it reaches."""
        layers = dict(zip(STUFF_CLASSES, self.stuff, strict=True)) | {THING_CLASS: self.things >= 0}
        cells = np.zeros(self.things.shape, dtype=np.uint8)
        for name, layer in layers.items():
            cells |= layer.astype(np.uint8) * np.uint8(MAP_CLASSES[name])
        return BevMap(cells[::-1].copy(), grid.x_range_m, grid.y_range_m)


def decode_maps(outputs: SegmentationOutputs, config: SegmentationConfig, grid: BevGrid) -> list[PanopticMap]:
    """The masks of the last layer, merged: one map a batch element, `map_scale` times as fine as the grid.

    Vehicles compete for cells; the classes lie upon each other, as they do on the ground.
    """
    masks = outputs.mask_logits[-1].detach().float().sigmoid().unflatten(-1, (grid.rows, grid.columns))
    probabilities = masks * outputs.class_logits[-1].detach().float().sigmoid()[..., None, None]
    return [_panoptic_map(element, config) for element in probabilities]


def merge(probabilities: Tensor, least: float, scale: int) -> NDArray[np.int64]:
    """(Q, rows, columns) of competing queries -> (scale · rows, scale · columns): whose a cell is, -1 nobody's."""
    seen = (probabilities.amax((1, 2)) > least).nonzero()[:, 0]  # the others can win no cell
    nobody = probabilities.new_full((1, *probabilities.shape[1:]), least)
    winner = _finer(torch.cat([nobody, probabilities[seen]]), scale).argmax(0)
    owners: NDArray[np.int64] = torch.cat([seen.new_full((1,), -1), seen])[winner].cpu().numpy()
    return owners


def _panoptic_map(probabilities: Tensor, config: SegmentationConfig) -> PanopticMap:
    count = len(STUFF_CLASSES)
    stuff = _finer(probabilities[:count], config.map_scale) > config.min_stuff
    return PanopticMap(stuff.cpu().numpy(), merge(probabilities[count:], config.min_thing, config.map_scale))


def _finer(layers: Tensor, scale: int) -> Tensor:
    """(K, rows, columns) -> (K, scale · rows, scale · columns), bilinear between the cells' middles."""
    return F.interpolate(layers[None], scale_factor=scale, mode="bilinear", align_corners=False)[0]
