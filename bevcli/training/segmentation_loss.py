"""The segmentation loss: targets from maps and boxes, then focal, dice and L1 loss after each mask layer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bevcli.errors import InputError
from bevcli.frame import BevMap
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass
from bevcli.model.matching import focal_cost, focal_loss, hungarian_matching
from bevcli.model.segmentation import STUFF_CLASSES, SegmentationOutputs
from bevcli.training.detection_loss import has_points

# A cell belongs to a class that covers at least this share of it. Lines are thinner than a cell: their share is lower.
MIN_SHARES = {"drivable_road": 0.4, "lane_boundary": 0.2, "pedestrian_crossing": 0.4}
DICE_SMOOTHING = 1e-3
SAMPLES = 8  # sampling points along each side of a BEV cell


@dataclass(frozen=True)
class SegmentationTargets:
    """The masks of one frame: S stuff classes and G vehicles.

    Attributes:
        stuff: (S, Y·X) float32 masks of 0 and 1 in the order of STUFF_CLASSES; None if the frame has no map.
        things: (G, Y·X) float32 masks of 0 and 1.
        locations: (G, 4) float32 centre x, y and extent x, y of each vehicle, as fractions (0 to 1) of the grid.
    """

    stuff: Tensor | None
    things: Tensor
    locations: Tensor


def segmentation_targets(
    boxes: Boxes3D,
    bev_map: BevMap | None,
    grid: BevGrid,
    classes: Mapping[str, ObjectClass] = NUSCENES_CLASSES,
) -> SegmentationTargets:
    """Masks on the BEV grid. Raises InputError if the map does not cover the grid, or has none of STUFF_CLASSES.

    boxes: the frame's ground truth boxes, bev frame.
    """
    names = [name for name, one in classes.items() if one.vehicle]
    vehicles = boxes[np.isin(boxes.classes, names) & has_points(boxes)]
    vehicles = vehicles[(grid.cell_of(vehicles.centers[:, :2]) >= 0).all(-1)]
    stuff = None if bev_map is None else torch.from_numpy(_stuff(bev_map, grid)).float()
    footprints, locations = (torch.from_numpy(make(vehicles, grid)).float() for make in (_footprints, _locations))
    return SegmentationTargets(stuff, footprints, locations)


def _stuff(bev_map: BevMap, grid: BevGrid) -> NDArray[np.bool_]:
    """(S, Y·X): whether a class covers enough of a cell."""
    _check_map(bev_map, grid)
    fine = BevGrid(grid.rows * SAMPLES, grid.columns * SAMPLES, grid.x_range_m, grid.y_range_m)
    rows, columns = bev_map.cells.shape
    map_grid = BevGrid(rows, columns, bev_map.x_range_m, bev_map.y_range_m)
    map_cells = map_grid.cell_of(fine.cell_centers())  # (Y · SAMPLES, X · SAMPLES, 2)
    on_map = np.stack([bev_map.layer(name)[::-1] for name in STUFF_CLASSES])  # the map's rows start at the largest y
    layers = on_map[:, map_cells[..., 0], map_cells[..., 1]]
    shares = layers.reshape(len(layers), grid.rows, SAMPLES, grid.columns, SAMPLES).mean((2, 4))
    min_shares = np.array([MIN_SHARES[name] for name in STUFF_CLASSES])
    return (shares >= min_shares[:, None, None]).reshape(len(layers), -1)


def _check_map(bev_map: BevMap, grid: BevGrid) -> None:
    if not set(STUFF_CLASSES) & set(bev_map.classes):
        raise InputError(
            f"a ground truth map has the classes {', '.join(bev_map.classes)}, but the segmentation head learns "
            f"{', '.join(STUFF_CLASSES)}: write other maps, or train without the segmentation head"
        )
    for axis, found, needed in (("x", bev_map.x_range_m, grid.x_range_m), ("y", bev_map.y_range_m, grid.y_range_m)):
        if found[0] > needed[0] or found[1] < needed[1]:
            raise InputError(
                f"a ground truth map covers {axis} {found[0]:g} to {found[1]:g} m, but the model's BEV grid "
                f"{needed[0]:g} to {needed[1]:g} m: write larger maps, or train without the segmentation head"
            )


def _footprints(vehicles: Boxes3D, grid: BevGrid) -> NDArray[np.bool_]:
    """(G, Y·X): the cells whose centre lies under the vehicle, and in any case the cell of the vehicle's centre."""
    cells = grid.cell_centers().reshape(-1, 2)
    from_center = cells - vehicles.centers[:, None, :2]  # (G, Y·X, 2)
    cos, sin = np.cos(vehicles.yaws)[:, None], np.sin(vehicles.yaws)[:, None]
    along = np.abs(cos * from_center[..., 0] + sin * from_center[..., 1])
    across = np.abs(cos * from_center[..., 1] - sin * from_center[..., 0])
    covered = (along <= vehicles.sizes_lwh[:, :1] / 2) & (across <= vehicles.sizes_lwh[:, 1:2] / 2)
    row, column = grid.cell_of(vehicles.centers[:, :2]).T
    covered[np.arange(len(vehicles)), row * grid.columns + column] = True
    return covered


def _locations(vehicles: Boxes3D, grid: BevGrid) -> NDArray[np.float64]:
    """(G, 4) centre and extent of the footprints' axis-aligned bounding rectangles, as fractions of the grid."""
    start, end = np.array([grid.x_range_m, grid.y_range_m]).T
    corners = vehicles.corners()[:, :4, :2]
    extent = corners.max(1) - corners.min(1) if len(vehicles) else np.zeros((0, 2))
    return np.concatenate([(vehicles.centers[:, :2] - start) / (end - start), extent / (end - start)], axis=-1)


@dataclass(frozen=True)
class SegmentationLossConfig:
    """The [training.segmentation_loss] table.

    Attributes:
        class_weight: of the focal loss of the classes.
        location_weight: of the L1 loss of the things' locations.
        dice_weight: of the dice loss of the masks.
        pixel_weight: of the focal loss of the masks, averaged over the cells of a mask.
    """

    class_weight: float = 1.0
    location_weight: float = 2.0
    dice_weight: float = 1.0
    pixel_weight: float = 10.0

    def __post_init__(self) -> None:
        if min(vars(self).values()) < 0:
            raise ValueError("the weights must not be negative")


def segmentation_loss(
    outputs: SegmentationOutputs, targets: Sequence[SegmentationTargets], config: SegmentationLossConfig
) -> dict[str, Tensor]:
    """The weighted losses of all layers for B frames. Things are matched once, by the outputs of the last layer.

    The losses of things are divided by the number of things in the batch, those of stuff by the number of stuff masks,
    so that many vehicles do not outweigh the road. A frame without a map trains no stuff query.
    """
    assignments = [_assign(outputs, element, truth, config) for element, truth in enumerate(targets)]
    things = sum(len(locations) for *_, locations in assignments)
    stuff = sum(len(queries) for queries, *_ in assignments) - things
    shares = outputs.class_logits.new_full(outputs.class_logits.shape[-1:], 1 / max(things, 1))  # (Q,)
    shares[: len(STUFF_CLASSES)] = 1 / max(stuff, 1)
    classes = config.class_weight * (_class_losses(outputs.class_logits, assignments, targets) * shares).sum()
    masks, locations = classes.new_zeros(()), classes.new_zeros(())
    for element, (queries, target_masks, target_locations) in enumerate(assignments):
        logits = outputs.mask_logits[:, element, queries]  # (M, K, Y·X)
        truth = target_masks.expand_as(logits)
        losses = config.dice_weight * dice_loss(logits, truth)
        losses = losses + config.pixel_weight * focal_loss(logits, truth).mean(-1)
        masks = masks + (losses * shares[queries]).sum()
        of_things = queries[len(queries) - len(target_locations) :] - len(STUFF_CLASSES)  # from the first thing query
        errors = outputs.locations[:, element, of_things] - target_locations
        locations = locations + config.location_weight * errors.abs().sum() / max(things, 1)
    return {"map classes": classes, "masks": masks, "locations": locations}


def matching_costs(
    outputs: SegmentationOutputs, element: int, truth: SegmentationTargets, config: SegmentationLossConfig
) -> Tensor:
    """(T, G) cost of assigning each thing query of a batch element to each vehicle, by the last layer."""
    first = len(STUFF_CLASSES)
    classes = focal_cost(outputs.class_logits[-1, element, first:])[:, None]
    locations = torch.cdist(outputs.locations[-1, element], truth.locations, p=1)
    dice = dice_costs(outputs.mask_logits[-1, element, first:], truth.things)
    return config.class_weight * classes + config.location_weight * locations + config.dice_weight * dice


def dice_loss(logits: Tensor, targets: Tensor) -> Tensor:
    """(...) dice loss with squared sums (V-Net), about 0 for equal masks and 1 for disjoint ones.

    logits: (..., cells). targets: (..., cells), 0 or 1.
    """
    masks = logits.sigmoid()
    return _dice((masks * targets).sum(-1), masks.square().sum(-1) + targets.square().sum(-1))


def dice_costs(logits: Tensor, targets: Tensor) -> Tensor:
    """(Q, G) dice loss of each predicted mask against each target mask.

    logits: (Q, cells). targets: (G, cells), 0 or 1.
    """
    masks = logits.sigmoid()
    return _dice(masks @ targets.T, masks.square().sum(-1)[:, None] + targets.square().sum(-1))


def _dice(overlap: Tensor, sums: Tensor) -> Tensor:
    return 1 - (2 * overlap + DICE_SMOOTHING) / (sums + DICE_SMOOTHING)


def _assign(
    outputs: SegmentationOutputs, element: int, truth: SegmentationTargets, config: SegmentationLossConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """The K queries of a batch element that have a target mask, (K,) stuff first, then T things; and their targets.

    These are the masks (K, Y·X), and of the things the locations (T, 4).
    """
    things, objects = hungarian_matching(matching_costs(outputs, element, truth, config))
    queries, masks = things + len(STUFF_CLASSES), truth.things[objects]
    if truth.stuff is not None:
        present = truth.stuff.any(-1)
        queries = torch.cat([present.nonzero()[:, 0], queries])
        masks = torch.cat([truth.stuff[present], masks])
    return queries, masks, truth.locations[objects]


def _class_losses(
    class_logits: Tensor, assignments: Sequence[tuple[Tensor, ...]], targets: Sequence[SegmentationTargets]
) -> Tensor:
    """(M, B, Q) focal losses of class_logits (M, B, Q), 0 for the stuff queries of a frame without a map."""
    class_targets, trained = torch.zeros_like(class_logits), torch.ones_like(class_logits)
    for element, ((queries, *_), truth) in enumerate(zip(assignments, targets, strict=True)):
        class_targets[:, element, queries] = 1
        if truth.stuff is None:
            trained[:, element, : len(STUFF_CLASSES)] = 0
    return focal_loss(class_logits, class_targets) * trained
