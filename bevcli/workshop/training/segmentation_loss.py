"""The segmentation loss: targets from maps and boxes, then focal, dice and L1 loss after each mask layer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bevcli.errors import InputError
from bevcli.frame import BevMap
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass
from bevcli.model.segmentation import STUFF_CLASSES, SegmentationOutputs
from bevcli.workshop.training.detection_loss import focal_cost, focal_loss, has_points, hungarian_matchings, pad_rows

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


@dataclass(frozen=True)
class PaddedMasks:
    """The masks of B frames, padded with zeros to the G vehicles of the frame with the most, at least 1.

    Attributes:
        stuff: (B, S, Y·X) float32; 0 where a frame has no map.
        has_stuff: (B,) bool, whether a frame has a map.
        things: (B, G, Y·X) float32.
        locations: (B, G, 4) float32.
        counts: B numbers of vehicles.
    """

    stuff: Tensor
    has_stuff: Tensor
    things: Tensor
    locations: Tensor
    counts: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.counts)

    def __getitem__(self, frame: int) -> SegmentationTargets:
        """The masks of one frame."""
        stuff, count = self.stuff[frame] if self.has_stuff[frame] else None, self.counts[frame]
        return SegmentationTargets(stuff, self.things[frame, :count], self.locations[frame, :count])


AnyMasks = Sequence[SegmentationTargets] | PaddedMasks  # of B frames


def padded_masks(targets: AnyMasks) -> PaddedMasks:
    """The masks of B frames as tensors."""
    if isinstance(targets, PaddedMasks):
        return targets
    nothing = targets[0].things.new_zeros(len(STUFF_CLASSES), targets[0].things.shape[-1])
    return PaddedMasks(
        torch.stack([nothing if one.stuff is None else one.stuff for one in targets]),
        torch.tensor([one.stuff is not None for one in targets]),
        pad_rows([one.things for one in targets]),
        pad_rows([one.locations for one in targets]),
        tuple(len(one.things) for one in targets),
    )


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
    map_rows, map_columns = bev_map.cells.shape
    map_grid = BevGrid(map_rows, map_columns, bev_map.x_range_m, bev_map.y_range_m)
    rows, columns = _sampled_cells(grid, map_grid)
    cells = bev_map.cells[::-1][rows[:, None], columns]  # the map's rows start at the largest y
    sampled = replace(bev_map, cells=cells)
    layers = np.stack([sampled.layer(name) for name in STUFF_CLASSES]).view(np.uint8)
    counts = layers.reshape(len(layers), grid.rows, SAMPLES, -1).sum(2, dtype=np.uint8)  # whole rows: fast
    shares = counts.reshape(len(layers), grid.rows, grid.columns, SAMPLES).sum(3, dtype=np.int64) / SAMPLES**2
    min_shares = np.array([MIN_SHARES[name] for name in STUFF_CLASSES])
    return (shares >= min_shares[:, None, None]).reshape(len(layers), -1)


@lru_cache
def _sampled_cells(grid: BevGrid, map_grid: BevGrid) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(Y · SAMPLES,) rows and (X · SAMPLES,) columns of the map at the sampling points of a grid."""
    fine = BevGrid(grid.rows * SAMPLES, grid.columns * SAMPLES, grid.x_range_m, grid.y_range_m)
    map_cells = map_grid.cell_of(fine.cell_centers())
    return map_cells[:, 0, 0], map_cells[0, :, 1]


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
    outputs: SegmentationOutputs, targets: AnyMasks, config: SegmentationLossConfig
) -> dict[str, Tensor]:
    """The weighted losses of all layers for B frames. Things are matched once, by the outputs of the last layer.

    The losses of things are divided by the number of things in the batch, those of stuff by the number of stuff masks,
    so that many vehicles do not outweigh the road. A frame without a map trains no stuff query.
    """
    truth, first = padded_masks(targets), len(STUFF_CLASSES)
    _, queries = hungarian_matchings(matching_costs(outputs, truth, config), truth.counts)  # (B, G)
    assigned = torch.cat([truth.stuff.any(-1), queries >= 0], 1).float()  # (B, S + G)
    queries = queries.clamp(min=0) + first
    stuff, things = assigned[:, :first].sum().clamp(min=1), assigned[:, first:].sum().clamp(min=1)
    layers = outputs.class_logits.shape[0]

    class_targets = torch.zeros_like(outputs.class_logits)  # (M, B, Q)
    class_targets[..., :first] = assigned[:, :first]
    of_things = assigned[:, first:]
    class_targets.scatter_add_(-1, *(x.expand(layers, -1, -1) for x in (queries, of_things)))
    class_losses = focal_loss(outputs.class_logits, class_targets)
    of_stuff = class_losses[..., :first] * truth.has_stuff[:, None]
    classes = of_stuff.sum() / stuff + class_losses[..., first:].sum() / things

    logits = _chosen(outputs.mask_logits, queries)  # (M, B, G, Y·X)
    logits = torch.cat([outputs.mask_logits[:, :, :first], logits], 2)
    masks = torch.cat([truth.stuff, truth.things], 1).expand_as(logits)
    losses = config.dice_weight * dice_loss(logits, masks)
    losses = (losses + config.pixel_weight * focal_loss(logits, masks).mean(-1)) * assigned
    errors = (_chosen(outputs.locations, queries - first) - truth.locations).abs().sum(-1) * of_things
    return {
        "map classes": config.class_weight * classes,
        "masks": losses[..., :first].sum() / stuff + losses[..., first:].sum() / things,
        "locations": config.location_weight * errors.sum() / things,
    }


def _chosen(tensor: Tensor, queries: Tensor) -> Tensor:
    """(M, B, Q, ...) -> (M, B, G, ...), those of the queries (B, G)."""
    index = queries[None, ..., None].expand(len(tensor), -1, -1, tensor.shape[-1])
    return tensor.gather(2, index)


def matching_costs(outputs: SegmentationOutputs, truth: PaddedMasks, config: SegmentationLossConfig) -> Tensor:
    """(B, T, G) cost of assigning each thing query to each vehicle, by the last layer. No gradient."""
    first = len(STUFF_CLASSES)
    with torch.no_grad():
        classes = focal_cost(outputs.class_logits[-1, :, first:])[..., None]
        locations = torch.cdist(outputs.locations[-1], truth.locations, p=1)
        dice = dice_costs(outputs.mask_logits[-1, :, first:], truth.things)
        return config.class_weight * classes + config.location_weight * locations + config.dice_weight * dice


def dice_loss(logits: Tensor, targets: Tensor) -> Tensor:
    """(...) dice loss with squared sums (V-Net), about 0 for equal masks and 1 for disjoint ones.

    logits: (..., cells). targets: (..., cells), 0 or 1.
    """
    masks = logits.sigmoid()
    return _dice((masks * targets).sum(-1), masks.square().sum(-1) + targets.square().sum(-1))


def dice_costs(logits: Tensor, targets: Tensor) -> Tensor:
    """(..., Q, G) dice loss of each predicted mask against each target mask.

    logits: (..., Q, cells). targets: (..., G, cells), 0 or 1.
    """
    masks = logits.sigmoid()
    sums = masks.square().sum(-1)[..., None] + targets.square().sum(-1)[..., None, :]
    return _dice(masks @ targets.mT, sums)


def _dice(overlap: Tensor, sums: Tensor) -> Tensor:
    return 1 - (2 * overlap + DICE_SMOOTHING) / (sums + DICE_SMOOTHING)
