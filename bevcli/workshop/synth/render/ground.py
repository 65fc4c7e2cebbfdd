"""The painted ground: as a texture with mip levels, as the ground truth map, and as true lines."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from shapely import LineString, Polygon, union_all
from shapely.geometry.base import BaseGeometry

from bevcli.frame import MAP_CLASSES, BevMap
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import VEHICLE_CLASSES
from bevcli.geometry.transforms import Array, apply
from bevcli.workshop.synth.assets.paint import linear
from bevcli.workshop.synth.world.ground_plan import ASPHALT, GroundPiece
from bevcli.workshop.synth.world.weather import tiling_noise
from bevcli.workshop.vad.map_lines import LINE_CLASSES, MapLines
from bevcli.workshop.vad.true_lines import lines_in_area

SUBPIXEL_BITS = 4  # fractional bits of polygon corners in OpenCV
LEVELS = 6  # mip levels; each has half the resolution of the one before
ROUGH_SIZE = 256


@dataclass(frozen=True)
class GroundTexture:
    """A square of the ground in the world frame, rows along y.

    Attributes:
        texels: (K, 3) square root of linear RGB, 0 to 255; all levels one after another, the finest first.
        rough: (256, 256) made by `roughness`.
        offsets: (LEVELS,) index of the first texel of each level.
        origin: x and y of the first texel's corner, metres.
        texel_m: size of a texel of the finest level, metres.
        size: texels along a side of the finest level, a multiple of 2^(LEVELS - 1).
    """

    texels: NDArray[np.uint8]
    rough: NDArray[np.float32]
    offsets: NDArray[np.int64]
    origin: tuple[float, float]
    texel_m: float
    size: int


def paint_ground(pieces: list[GroundPiece], center: ArrayLike, extent_m: float, texel_m: float) -> GroundTexture:
    """Paint a square of about `extent_m` metres around a world point (2,). texel_m: size of a texel, metres."""
    block = 2 ** (LEVELS - 1)
    size = round(extent_m / texel_m / block) * block
    origin = np.asarray(center, dtype=np.float64) - size * texel_m / 2
    canvas = np.full((size, size, 3), _stored(ASPHALT), np.uint8)
    for piece in pieces:
        for paint in piece.paints:
            if paint.width_m > texel_m / 2:
                fill(canvas, (paint.outline - origin) / texel_m - 0.5, _stored(paint.color))
    levels = [canvas]
    for _ in range(LEVELS - 1):
        levels.append(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    offsets = np.cumsum([0, *(level.shape[0] ** 2 for level in levels[:-1])])
    texels = np.concatenate([level.reshape(-1, 3) for level in levels])
    return GroundTexture(texels, roughness(), offsets, (float(origin[0]), float(origin[1])), texel_m, size)


def fill(canvas: NDArray[np.uint8], outline: NDArray[np.float64], color: tuple[int, ...] | int) -> None:
    """Fill a polygon (P, 2) of pixel positions (x, y) into an image, in place. Edges are exact to 1/16 of a pixel."""
    low, high = outline.min(0), outline.max(0)
    if high[0] < 0 or high[1] < 0 or low[0] > canvas.shape[1] or low[1] > canvas.shape[0]:
        return
    fixed = np.round(outline * 2**SUBPIXEL_BITS).astype(np.int32)
    smooth = cv2.LINE_AA if canvas.ndim == 3 else cv2.LINE_8
    cv2.fillPoly(canvas, [fixed], color, smooth, SUBPIXEL_BITS)


@lru_cache(maxsize=256)
def _stored(color: tuple[int, int, int]) -> tuple[int, ...]:
    """An sRGB colour as texels hold it."""
    return tuple(round(float(np.sqrt(c)) * 255) for c in linear(color))


def roughness() -> NDArray[np.float32]:
    """(256, 256) relative brightness of worn ground, around 0; it repeats every 256 * ROUGH_TEXEL_M metres."""
    rng = np.random.Generator(np.random.PCG64(7))
    total = np.zeros((ROUGH_SIZE, ROUGH_SIZE))
    for cells, strength in ((8, 0.22), (64, 0.20)):
        total += strength * tiling_noise(rng, ROUGH_SIZE, cells, -0.5)
    return total.astype(np.float32)


CELL_M = 0.25  # size of a cell of the map
BOUNDARY_M = 0.5  # width of lane boundaries in the map; wider than their paint, so that no cell misses them


def draw_map(
    pieces: list[GroundPiece], boxes_world: Boxes3D, bev_from_world: Array, half_extent_m: float = 32.0
) -> BevMap:
    """Draw the map of a square of the bev frame.

    pieces: the painted ground around the vehicle. boxes_world: boxes in the world frame; only those of
    VEHICLE_CLASSES are drawn. bev_from_world: (4, 4). half_extent_m: from the origin to each side of the square.
    """

    def pixels(points: Array) -> Array:
        """Column and row (P, 2); (0, 0) is the middle of the first cell."""
        return (moved(bev_from_world, points) * (1, -1) + half_extent_m) / CELL_M - 0.5

    side = round(2 * half_extent_m / CELL_M)
    layers = {name: np.zeros((side, side), np.uint8) for name in MAP_CLASSES}
    for piece in pieces:
        for outline in piece.roads:
            fill(layers["drivable_road"], pixels(outline), 1)
        for outline in piece.crossings:
            fill(layers["pedestrian_crossing"], pixels(outline), 1)
        for line in piece.lane_boundaries:
            fixed = np.round(pixels(line) * 2**SUBPIXEL_BITS).astype(np.int32)
            width = round(BOUNDARY_M / CELL_M)
            cv2.polylines(layers["lane_boundary"], [fixed], False, 1, width, cv2.LINE_8, SUBPIXEL_BITS)
    vehicles = boxes_world[np.isin(boxes_world.classes, VEHICLE_CLASSES)]
    for corners in vehicles.corners():
        fill(layers["vehicle"], pixels(corners[:4, :2]), 1)
    cells = sum((layer * MAP_CLASSES[name] for name, layer in layers.items()), np.zeros_like(layers["vehicle"]))
    extent = (-half_extent_m, half_extent_m)
    return BevMap(cells.astype(np.uint8), extent, extent)


def moved(bev_from_world: Array, points: Array) -> Array:
    """Points (P, 2) of the ground, from the world frame to the bev frame."""
    return apply(bev_from_world, np.pad(points, ((0, 0), (0, 1))))[:, :2]


GAP_M = 0.05  # roads so near to each other are one
DIVIDER, CROSSING, BOUNDARY = LINE_CLASSES


def true_lines(pieces: list[GroundPiece], bev_from_world: Array) -> MapLines:
    """Lane dividers, pedestrian crossings (closed) and road boundaries, as by `lines_in_area`, bev frame."""
    outlines = [moved(bev_from_world, road) for piece in pieces for road in piece.roads]
    roads = union_all([Polygon(outline).buffer(GAP_M) for outline in outlines]).buffer(-GAP_M)
    found: list[tuple[str, BaseGeometry]] = [(BOUNDARY, roads.boundary)]
    for piece in pieces:
        found += [(DIVIDER, LineString(moved(bev_from_world, line))) for line in piece.lane_boundaries]
        found += [(CROSSING, Polygon(moved(bev_from_world, outline)).boundary) for outline in piece.crossings]
    return lines_in_area(found)
