"""Targets of a training: the ground truth boxes and masks of frames, and what a model with heads of its own adds.

The boxes and masks of one frame are made on the CPU; a batch has them padded, so that one copy moves them to a GPU.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
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


@dataclass(frozen=True)
class DetectionTargets:
    """The G ground truth boxes of one frame."""

    labels: Tensor  # (G,) int64, indices into the model's classes
    codes: Tensor  # (G, 10) float32 box codes (see `bevcli.model.decoder`); unknown velocities are NaN


@dataclass(frozen=True)
class PaddedTargets:
    """The ground truth boxes of B frames, padded to the G boxes of the frame with the most, at least 1."""

    labels: Tensor  # (B, G) int64, indices into the model's classes; 0 for padding
    codes: Tensor  # (B, G, 10) float32 box codes; 0 for padding
    exists: Tensor  # (B, G) bool, false for padding
    counts: tuple[int, ...]  # B numbers of boxes

    def __len__(self) -> int:
        return len(self.counts)

    def __getitem__(self, frame: int) -> DetectionTargets:
        """The boxes of one frame."""
        count = self.counts[frame]
        return DetectionTargets(self.labels[frame, :count], self.codes[frame, :count])


AnyTargets = Sequence[DetectionTargets] | PaddedTargets  # of B frames


def padded(targets: AnyTargets) -> PaddedTargets:
    """The boxes of B frames as tensors."""
    if isinstance(targets, PaddedTargets):
        return targets
    counts = tuple(len(boxes.labels) for boxes in targets)
    labels, codes = (pad_rows([getattr(boxes, name) for boxes in targets]) for name in ("labels", "codes"))
    exists = pad_rows([torch.ones_like(boxes.labels, dtype=torch.bool) for boxes in targets])
    return PaddedTargets(labels, codes, exists, counts)


def pad_rows(tensors: Sequence[Tensor]) -> Tensor:
    """(B, G, ...) of B tensors (G_i, ...), padded with zeros to the largest of G_i, at least 1."""
    rows = max(1, *map(len, tensors))
    out = tensors[0].new_zeros(len(tensors), rows, *tensors[0].shape[1:])
    for padded_rows, tensor in zip(out, tensors, strict=True):
        padded_rows[: len(tensor)] = tensor
    return out


def detection_targets(boxes: Boxes3D, config: ModelConfig) -> DetectionTargets:
    """The `box_targets` of the boxes (ground truth, bev frame) with a centre inside the BEV grid."""
    grid = config.bev_grid
    low, high = np.array([grid.x_range_m, grid.y_range_m, grid.z_range_m]).T
    return box_targets(boxes[((boxes.centers >= low) & (boxes.centers <= high)).all(-1)], config.classes)


def box_targets(boxes: Boxes3D, classes: tuple[str, ...]) -> DetectionTargets:
    """Targets from all boxes (ground truth, bev frame) that have one of the classes and visible points."""
    kept = boxes[np.isin(boxes.classes, classes) & has_points(boxes)]
    labels = [classes.index(name) for name in kept.classes]
    return DetectionTargets(torch.tensor(labels, dtype=torch.int64), torch.from_numpy(encode(kept)).float())


def has_points(boxes: Boxes3D) -> NDArray[np.bool_]:
    """(N,) bool, false where the ground truth counts 0 points; boxes without a count are kept."""
    return np.ones(len(boxes), dtype=bool) if boxes.num_points is None else boxes.num_points != 0


# A cell belongs to a class that covers at least this share of it. Lines are thinner than a cell: their share is lower.
MIN_SHARES = {"drivable_road": 0.4, "lane_boundary": 0.2, "pedestrian_crossing": 0.4}
SAMPLES = 8  # sampling points along each side of a BEV cell


@dataclass(frozen=True)
class SegmentationTargets:
    """The masks of one frame: S stuff classes and G vehicles."""

    stuff: Tensor | None  # (S, Y·X) float32, 0 or 1, in the order of STUFF_CLASSES; None without a map
    things: Tensor  # (G, Y·X) float32 masks of 0 and 1
    locations: Tensor  # (G, 4) float32 centre x, y and extent x, y of each vehicle, as fractions (0 to 1) of the grid


@dataclass(frozen=True)
class PaddedMasks:
    """The masks of B frames, padded with zeros to the G vehicles of the frame with the most, at least 1."""

    stuff: Tensor  # (B, S, Y·X) float32; 0 where a frame has no map
    has_stuff: Tensor  # (B,) bool, whether a frame has a map
    things: Tensor  # (B, G, Y·X) float32
    locations: Tensor  # (B, G, 4) float32
    counts: tuple[int, ...]  # B numbers of vehicles

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
        torch.stack([nothing if masks.stuff is None else masks.stuff for masks in targets]),
        torch.tensor([masks.stuff is not None for masks in targets]),
        pad_rows([masks.things for masks in targets]),
        pad_rows([masks.locations for masks in targets]),
        tuple(len(masks.things) for masks in targets),
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
    names = [name for name, settings in classes.items() if settings.vehicle]
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
    masks = [
        batch.segmentation[frame] for batch in batches if batch.segmentation for frame in range(len(batch.segmentation))
    ]
    return Targets(
        padded([batch.detection[frame] for batch in batches for frame in range(len(batch.detection))]),
        padded([batch.perspective[frame] for batch in batches for frame in range(len(batch.perspective))]),
        padded_masks(masks) if masks else None,
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
    boxes = ground_truth_boxes(frame)
    detection, perspective = padded([detection_targets(boxes, config)]), padded([box_targets(boxes, config.classes)])
    if "segmentation" not in config.heads:
        return Targets(detection, perspective, None)
    masks = segmentation_targets(boxes, frame.ground_truth_map, config.bev_grid, config.object_classes)
    return Targets(detection, perspective, padded_masks([masks]))
