"""The ground truth map: roads, lane boundaries, crossings and vehicles seen from above in the bev frame."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.frame import MAP_CLASSES, BevMap
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, apply
from bevcli.synth.render.ground_texture import SUBPIXEL_BITS, fill
from bevcli.synth.world.ground_plan import GroundPiece

BOUNDARY_M = 0.5  # how wide lane boundaries are drawn, wider than their paint so that cells do not miss them
VEHICLE_CLASSES = ("car", "truck", "construction_vehicle", "bus", "trailer", "motorcycle", "bicycle")


@dataclass(frozen=True)
class MapWindow:
    """A square of the bev frame: half_extent_m to each side, in cells of cell_m."""

    half_extent_m: float = 32.0
    cell_m: float = 0.25

    @property
    def cells(self) -> int:
        """Cells along a side."""
        return round(2 * self.half_extent_m / self.cell_m)

    def pixels(self, points_bev: Array) -> Array:
        """Points (P, 2+) in the bev frame -> (P, 2) column and row; the first cell's middle is (0, 0)."""
        columns = (points_bev[..., 0] + self.half_extent_m) / self.cell_m - 0.5
        rows = (self.half_extent_m - points_bev[..., 1]) / self.cell_m - 0.5
        return np.stack([columns, rows], -1)


def draw_map(pieces: list[GroundPiece], boxes_world: Boxes3D, bev_from_world: Array, window: MapWindow) -> BevMap:
    """The map of painted ground (world) and of boxes (world) around the vehicle. bev_from_world: (4, 4)."""

    def pixels(points: Array) -> Array:
        world = np.column_stack([points[:, :2], np.zeros(len(points))])
        return window.pixels(apply(bev_from_world, world))

    layers: dict[str, NDArray[np.uint8]] = {
        name: np.zeros((window.cells, window.cells), np.uint8) for name in MAP_CLASSES
    }
    for piece in pieces:
        for outline in piece.roads:
            fill(layers["drivable_road"], pixels(outline), 1)
        for outline in piece.crossings:
            fill(layers["pedestrian_crossing"], pixels(outline), 1)
        for line in piece.lane_boundaries:
            fixed = np.round(pixels(line) * 2**SUBPIXEL_BITS).astype(np.int32)
            width = max(round(BOUNDARY_M / window.cell_m), 1)
            cv2.polylines(layers["lane_boundary"], [fixed], False, 1, width, cv2.LINE_8, SUBPIXEL_BITS)
    vehicles = boxes_world[np.isin(boxes_world.classes, VEHICLE_CLASSES)]
    for corners in vehicles.corners():
        fill(layers["vehicle"], pixels(corners[:4]), 1)
    cells = sum((layer * MAP_CLASSES[name] for name, layer in layers.items()), np.zeros_like(layers["vehicle"]))
    extent = (-window.half_extent_m, window.half_extent_m)
    return BevMap(cells.astype(np.uint8), extent, extent)
