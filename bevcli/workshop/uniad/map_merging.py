"""Merges the masks of the map head into one map."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from bevcli.frame import BevMap
from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.segmentation import map_of_layers
from bevcli.workshop.uniad.map_head import MapHeadConfig, MapOutputs


@dataclass(frozen=True)
class MergedMap:
    """The classes and the instances of every cell of the BEV grid; rows from the smallest y.

    Attributes:
        stuff: (S, rows, columns) bool, in the order of `MapHeadConfig.stuff`.
        things: (classes, rows, columns) bool, in the order of `MapHeadConfig.things`; a cell may have several classes.
        instances: (rows, columns) int64, the number of a cell's instance from 1, 0 for none.
        instance_labels: class of each instance, an index into `MapHeadConfig.things`, by falling score.
        instance_scores: score of each instance, 0 or larger.
    """

    stuff: NDArray[np.bool_]
    things: NDArray[np.bool_]
    instances: NDArray[np.int64]
    instance_labels: tuple[int, ...]
    instance_scores: tuple[float, ...]

    def bev_map(self, grid: BevGrid, config: MapHeadConfig) -> BevMap:
        """The classes without instances, rows from the largest y.

        Things are moved by `config.thing_offset_m`, rounded to whole cells; cells that leave the grid are lost.

        grid: gives the ranges that the map covers. config: of the map head.
        """
        (x, y), (size_x, size_y) = config.thing_offset_m, grid.cell_size_m
        things = _moved(self.things, rows=round(y / size_y), columns=round(x / size_x))
        return map_of_layers([*self.stuff, *things], config.classes, grid)


def merge_map(outputs: MapOutputs, config: MapHeadConfig, grid: BevGrid) -> MergedMap:
    """The map of a batch of one.

    A cell has a stuff class where its mask is larger than `config.min_mask`. Things are written by falling score, with
    the rules of the released code: see `_merge_things`.
    """
    found = (outputs.thing_masks, outputs.stuff_masks, outputs.scores)
    masks, stuff, scores = (each[0].detach().float() for each in found)
    labels, shape = outputs.labels[0], (grid.rows, grid.columns)
    scores, order = thing_scores(masks, scores, config.min_mask).sort(descending=True)
    order = order[scores >= config.min_score]
    cells = (masks[order] > config.min_mask).unflatten(-1, shape).cpu().numpy()
    things, instances, kept = _merge_things(cells, labels[order].tolist(), config)
    return MergedMap(
        stuff=(stuff > config.min_mask).unflatten(-1, shape).cpu().numpy(),
        things=things,
        instances=instances,
        instance_labels=tuple(labels[order][kept].tolist()),
        instance_scores=tuple(scores[kept].tolist()),
    )


def thing_scores(masks: Tensor, scores: Tensor, min_mask: float) -> Tensor:
    """Class score times the square of the mask's mean over its cells: (K,), 0 or larger.

    The mean's denominator is the number of cells plus 1, so that an empty mask scores 0.
    masks: (K, Y·X). scores: (K,) class scores. min_mask: a cell belongs to a mask where this is larger.
    """
    inside = masks > min_mask
    mean = (masks * inside).sum(-1) / (inside.sum(-1) + 1)
    return scores * mean**2


def _merge_things(
    masks: NDArray[np.bool_], labels: list[int], config: MapHeadConfig
) -> tuple[NDArray[np.bool_], NDArray[np.int64], list[int]]:
    """Writes things over each other, those with better scores first.

    A thing is left out if more than `config.max_overlap` of its cells are taken; else it gets those that are not taken.
    As in the released code, things of the first class (dividers) take no cells: others may be written over them.

    masks: (K, rows, columns). labels: K classes, indices into `config.things`. Returns the cells of each class
    (classes, rows, columns); the number of the instance from 1, 0 for none (rows, columns); and the indices of the
    things that are instances, in the order of their numbers.
    """
    layers = np.zeros((len(config.things), *masks.shape[1:]), dtype=bool)
    instances = np.zeros(masks.shape[1:], dtype=np.int64)
    taken = np.zeros(masks.shape[1:], dtype=bool)
    kept: list[int] = []
    for index, (mask, label) in enumerate(zip(masks, labels, strict=True)):
        count = int(mask.sum())
        if count == 0 or int((mask & taken).sum()) / count > config.max_overlap:
            continue
        free = mask & ~taken
        kept.append(index)
        layers[label] |= free
        instances[free] = len(kept)
        taken[free] = label > 0
    return layers, instances, kept


def _moved(layers: NDArray[np.bool_], rows: int, columns: int) -> NDArray[np.bool_]:
    """Layers (K, Y, X), moved by whole cells; what leaves the grid is lost."""
    _, height, width = layers.shape
    y, x = abs(rows), abs(columns)
    padded = np.pad(layers, ((0, 0), (y, y), (x, x)))
    return padded[:, y - rows : y - rows + height, x - columns : x - columns + width]
