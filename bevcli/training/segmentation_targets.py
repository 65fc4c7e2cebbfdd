"""Ground truth maps and boxes as targets of the segmentation head: stuff from the map, things from vehicle boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bevcli.errors import InputError
from bevcli.frame import BevMap
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.model.segmentation import STUFF_CLASSES
from bevcli.synth.render.bev_map import VEHICLE_CLASSES
from bevcli.training.detection_targets import has_points

# A cell belongs to a class that covers at least this share of it. Lines are thinner than a cell: their share is lower.
MIN_SHARES = {"drivable_road": 0.4, "lane_boundary": 0.2, "pedestrian_crossing": 0.4}
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

    def to(self, device: torch.device) -> SegmentationTargets:
        """A copy on a device."""
        stuff = None if self.stuff is None else self.stuff.to(device)
        return SegmentationTargets(stuff, self.things.to(device), self.locations.to(device))


def segmentation_targets(boxes: Boxes3D, bev_map: BevMap | None, grid: BevGrid) -> SegmentationTargets:
    """Masks on the BEV grid. Raises InputError if the map does not cover the grid, or has none of STUFF_CLASSES.

    Args:
        boxes: the frame's ground truth boxes, bev frame.
    """
    vehicles = boxes[np.isin(boxes.classes, VEHICLE_CLASSES) & has_points(boxes)]
    vehicles = vehicles[(grid.cell_of(vehicles.centers[:, :2]) >= 0).all(-1)]
    stuff = None if bev_map is None else torch.from_numpy(_stuff(bev_map, grid)).float()
    return SegmentationTargets(
        stuff,
        torch.from_numpy(_footprints(vehicles, grid)).float(),
        torch.from_numpy(_locations(vehicles, grid)).float(),
    )


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
