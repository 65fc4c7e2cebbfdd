"""Targets of a training: the ground truth boxes and masks of frames, and what a model with heads of its own adds.

The boxes and masks of one frame are made on the CPU; a batch has them padded, so that one copy moves them to a GPU.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain
from typing import Any, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from bevcli.errors import InputError
from bevcli.frame import BevMap, Frame
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass
from bevcli.geometry.transforms import inverse
from bevcli.model.config import ModelConfig
from bevcli.model.decoder import encode
from bevcli.model.segmentation import STUFF_CLASSES
from bevcli.model.upload import exchanged, pinned, tensors_in, upload

T = TypeVar("T", "PaddedTargets", "PaddedMasks")


@dataclass(frozen=True)
class PaddedTargets:
    """The ground truth boxes of B frames, padded to the G boxes of the frame with the most, at least 1."""

    labels: Tensor  # (B, G) int64, indices into the model's classes; 0 for padding
    # (B, G, 10) float32 box codes (see `bevcli.model.decoder`); unknown velocities are NaN; 0 for padding
    codes: Tensor
    exists: Tensor  # (B, G) bool, false for padding
    counts: tuple[int, ...]  # B numbers of boxes

    @staticmethod
    def of_frame(labels: Tensor, codes: Tensor) -> "PaddedTargets":
        """Of one frame: labels (G,) and codes (G, 10)."""
        columns, count = (labels, codes, torch.ones_like(labels, dtype=torch.bool)), len(labels)
        labels, codes, exists = (_padded(column[None], max(1, count)) for column in columns)
        return PaddedTargets(labels, codes, exists, (count,))


def _padded(tensor: Tensor, rows: int) -> Tensor:
    """(B, G, ...) with zeros below -> (B, rows, ...)."""
    return F.pad(tensor, (0, 0) * (tensor.ndim - 2) + (0, rows - tensor.shape[1]))


def of_all(parts: Sequence[T]) -> T:
    """The boxes, or masks, of all frames of several parts."""
    columns: list[Any] = []
    for values in zip(*(vars(part).values() for part in parts), strict=True):
        if isinstance(values[0], Tensor):
            rows = max(value.shape[1] for value in values)
            columns.append(torch.cat([_padded(value, rows) for value in values]))
        else:
            columns.append(tuple(chain(*values)))
    return type(parts[0])(*columns)


def detection_targets(boxes: Boxes3D, config: ModelConfig) -> PaddedTargets:
    """The `box_targets` of the boxes (ground truth, bev frame) with a centre inside the BEV grid."""
    grid = config.bev_grid
    low, high = np.array([grid.x_range_m, grid.y_range_m, grid.z_range_m]).T
    return box_targets(boxes[((boxes.centers >= low) & (boxes.centers <= high)).all(-1)], config.classes)


def box_targets(boxes: Boxes3D, classes: tuple[str, ...]) -> PaddedTargets:
    """Targets of one frame from all boxes (ground truth, bev frame) that have one of the classes and visible points."""
    kept = boxes[np.isin(boxes.classes, classes) & has_points(boxes)]
    labels = [classes.index(name) for name in kept.classes]
    return PaddedTargets.of_frame(torch.tensor(labels, dtype=torch.int64), torch.from_numpy(encode(kept)).float())


def has_points(boxes: Boxes3D) -> NDArray[np.bool_]:
    """(N,) bool, false where the ground truth counts 0 points; boxes without a count are kept."""
    return np.ones(len(boxes), dtype=bool) if boxes.num_points is None else boxes.num_points != 0


# A cell belongs to a class that covers at least this share of it. Lines are thinner than a cell: their share is lower.
MIN_SHARES = {"drivable_road": 0.4, "lane_boundary": 0.2, "pedestrian_crossing": 0.4}
SAMPLES = 8  # sampling points along each side of a BEV cell


@dataclass(frozen=True)
class PaddedMasks:
    """The masks of B frames, padded with zeros to the G vehicles of the frame with the most, at least 1."""

    stuff: Tensor  # (B, S, Y·X) float32, 0 or 1, in the order of STUFF_CLASSES; 0 where a frame has no map
    has_stuff: Tensor  # (B, 1) bool, whether a frame has a map
    things: Tensor  # (B, G, Y·X) float32 masks of 0 and 1
    # (B, G, 4) float32 centre x, y and extent x, y of each vehicle, as fractions (0 to 1) of the grid
    locations: Tensor
    counts: tuple[int, ...]  # B numbers of vehicles

    @staticmethod
    def of_frame(stuff: Tensor | None, things: Tensor, locations: Tensor) -> "PaddedMasks":
        """Of one frame: stuff (S, Y·X), None without a map; things (G, Y·X) and locations (G, 4)."""
        count, has_stuff = len(things), torch.tensor([[stuff is not None]])
        stuff = things.new_zeros(len(STUFF_CLASSES), things.shape[-1]) if stuff is None else stuff
        things, locations = (_padded(column[None], max(1, count)) for column in (things, locations))
        return PaddedMasks(stuff[None], has_stuff, things, locations, (count,))


def segmentation_targets(
    boxes: Boxes3D,
    bev_map: BevMap | None,
    grid: BevGrid,
    classes: Mapping[str, ObjectClass] = NUSCENES_CLASSES,
) -> PaddedMasks:
    """Masks of one frame on the BEV grid. boxes: its ground truth boxes, bev frame.

    Raises InputError if the map does not cover the grid, or has none of STUFF_CLASSES.
    """
    names = [name for name, settings in classes.items() if settings.vehicle]
    vehicles = boxes[np.isin(boxes.classes, names) & has_points(boxes)]
    vehicles = vehicles[(grid.cell_of(vehicles.centers[:, :2]) >= 0).all(-1)]
    stuff = None if bev_map is None else torch.from_numpy(_stuff(bev_map, grid)).float()
    footprints, locations = (torch.from_numpy(make(vehicles, grid)).float() for make in (_footprints, _locations))
    return PaddedMasks.of_frame(stuff, footprints, locations)


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
    for axis, covered, needed in (("x", bev_map.x_range_m, grid.x_range_m), ("y", bev_map.y_range_m, grid.y_range_m)):
        if covered[0] > needed[0] or covered[1] < needed[1]:
            raise InputError(
                f"a ground truth map covers {axis} {covered[0]:g} to {covered[1]:g} m, but the model's BEV grid "
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
class Targets:
    """The targets of B frames, one of each clip."""

    detection: PaddedTargets  # B, the boxes inside the BEV grid
    perspective: PaddedTargets  # B, all boxes, for the perspective loss
    segmentation: PaddedMasks | None  # B, or None if the model has no segmentation head

    def to(self, device: torch.device) -> "Targets":
        """A copy on a device."""
        targets: Targets = exchanged(self, (upload(tensor, device) for _, tensor in tensors_in(self)))
        return targets

    def pinned(self) -> "Targets":
        """A copy in memory that a GPU reads by itself."""
        targets: Targets = exchanged(self, (pinned(tensor) for _, tensor in tensors_in(self)))
        return targets


def joined_targets(batches: Sequence[Targets]) -> Targets:
    masks = [batch.segmentation for batch in batches if batch.segmentation is not None]
    return Targets(
        of_all([batch.detection for batch in batches]),
        of_all([batch.perspective for batch in batches]),
        of_all(masks) if masks else None,
    )


def ground_truth_boxes(frame: Frame) -> Boxes3D:
    """The ground truth boxes in the bev frame. Raises InputError if the frame has none."""
    if frame.ground_truth is None:
        raise InputError(
            f"frame {frame.stamp.index} of {frame.stamp.scene or 'the drive'} has no ground truth boxes: "
            "training needs ground_truth.json (bevcli convert writes it)"
        )
    return frame.ground_truth.transformed(inverse(frame.world_from_ego.matrix @ frame.rig.ego_from_bev))


def frame_targets(frame: Frame, config: ModelConfig) -> Targets:
    boxes, masks = ground_truth_boxes(frame), None
    if "segmentation" in config.heads:
        masks = segmentation_targets(boxes, frame.ground_truth_map, config.bev_grid, config.object_classes)
    return Targets(detection_targets(boxes, config), box_targets(boxes, config.classes), masks)
