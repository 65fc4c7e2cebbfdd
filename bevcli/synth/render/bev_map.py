"""The ground truth map: roads, lane boundaries, crossings and vehicles from above, in the bev frame."""

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

BOUNDARY_M = 0.5  # width of lane boundaries in the map; wider than their paint, so that no cell misses them
VEHICLE_CLASSES = ("car", "truck", "construction_vehicle", "bus", "trailer", "motorcycle", "bicycle")


@dataclass(frozen=True)
class MapWindow:
    """The square of the bev frame that a map covers.

    Attributes:
        half_extent_m: from the origin to each side, metres.
        cell_m: size of a cell, metres.
    """

    half_extent_m: float = 32.0
    cell_m: float = 0.25

    @property
    def cells(self) -> int:
        """Number of cells along a side."""
        return round(2 * self.half_extent_m / self.cell_m)

    def pixels(self, points_bev: Array) -> Array:
        """Column and row (P, 2) of points (P, 2 or 3) in the bev frame. (0, 0) is the middle of the first cell."""
        columns = (points_bev[..., 0] + self.half_extent_m) / self.cell_m - 0.5
        rows = (self.half_extent_m - points_bev[..., 1]) / self.cell_m - 0.5
        return np.stack([columns, rows], -1)


def draw_map(pieces: list[GroundPiece], boxes_world: Boxes3D, bev_from_world: Array, window: MapWindow) -> BevMap:
    """Draw the map.

    pieces: the painted ground around the vehicle. boxes_world: boxes in the world frame; only those of
    VEHICLE_CLASSES are drawn. bev_from_world: (4, 4).
    """

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
