"""The ground: roads, lane lines, crossings and pavements, as polygons in the world frame.

From these polygons are drawn the texture with mip levels, the ground truth map and the true lines.
"""

from collections.abc import Iterator
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
from bevcli.workshop.formats.map_lines import LINE_CLASSES, MapLines, lines_in_area
from bevcli.workshop.synth.city import CORNER_M, CROSSING_M, STOP_LINE_M, CityPlan, Street, along, rounded_rectangle
from bevcli.workshop.synth.mesh import Color, linear
from bevcli.workshop.synth.scenery import tiling_noise

WHITE: Color = (222, 222, 216)
YELLOW: Color = (214, 170, 54)
ASPHALT: Color = (92, 92, 95)
PARKING: Color = (99, 98, 99)
BIKE_LANE: Color = (96, 78, 74)
PAVEMENT: Color = (158, 154, 146)
JOINT: Color = (132, 128, 121)
KERB: Color = (186, 184, 178)
YARD: dict[str, Color] = {"houses": (128, 124, 116), "park": (92, 112, 62), "site": (142, 120, 92)}
LINE_M = 0.14  # width of lane lines


@dataclass(frozen=True)
class GroundPaint:
    """A polygon of one colour."""

    outline: Array  # (P, 2) world, metres
    color: Color  # sRGB
    width_m: float = float("inf")  # of a line; infinite for areas; coarser textures leave it out


@dataclass(frozen=True)
class GroundPiece:
    """The ground of one block, junction or stretch of street, in the world frame, metres."""

    paints: tuple[GroundPaint, ...]  # polygons in the order of painting
    roads: tuple[Array, ...] = ()  # polygons (P, 2) of the drivable road
    lane_boundaries: tuple[Array, ...] = ()  # polylines (P, 2)
    crossings: tuple[Array, ...] = ()  # polygons (P, 2) of pedestrian crossings


class GroundPlan:
    """The painted ground of a city. Pieces are made when they are first needed, and kept."""

    def __init__(self, city: CityPlan) -> None:
        self.city = city
        self._block = lru_cache(maxsize=None)(self._make_block)
        self._stretch = lru_cache(maxsize=None)(self._make_stretch)
        self._junction = lru_cache(maxsize=None)(self._make_junction)

    def pieces_around(self, center: ArrayLike, reach_m: float) -> list[GroundPiece]:
        """Pieces within `reach_m` metres of a world point (2,), in the order in which they must be painted."""
        near = self.city.around(center, reach_m * 1.1 + 10)
        return [
            *(self._block(*block) for block in near.blocks),
            *(self._stretch(*stretch) for stretch in near.stretches),
            *(self._junction(*node) for node in near.nodes),
        ]

    def _make_block(self, column: int, row: int) -> GroundPiece:
        city, block = self.city, self.city.block(column, row)
        (x0, y0), (x1, y1) = block.low, block.high
        outline = city.bend(block.kerb)
        inner = rounded_rectangle((x0 + 0.25, y0 + 0.25), (x1 - 0.25, y1 - 0.25), CORNER_M - 0.25)
        paints = [GroundPaint(outline, KERB), GroundPaint(city.bend(inner), PAVEMENT)]
        south, east, north, west = block.sidewalks
        x, y = np.arange(x0 + 1, x1 - 1, 1.5), np.arange(y0 + 1, y1 - 1, 1.5)
        for low, high in ((y0 + 0.3, y0 + south), (y1 - north, y1 - 0.3)):
            paints += self._bars([(at, low) for at in x], [(at, high) for at in x], 0.04, JOINT)
        for low, high in ((x0 + 0.3, x0 + west), (x1 - east, x1 - 0.3)):
            paints += self._bars([(low, at) for at in y], [(high, at) for at in y], 0.04, JOINT)
        yard = city.bend(rounded_rectangle(*block.inside(), 0.5))
        paints.append(GroundPaint(yard, YARD[city.landuse(column, row)]))
        return GroundPiece(tuple(paints))

    def _make_junction(self, column: int, row: int) -> GroundPiece:
        a, b = self.city.street(1, column), self.city.street(0, row)
        x, y = a.position, b.position
        outline = _junction_outline(x, y, a.half_width + CORNER_M, b.half_width + CORNER_M)
        paints: list[GroundPaint] = []
        crossings = []
        for street, across, sign in ((a, b, 1), (a, b, -1), (b, a, 1), (b, a, -1)):
            edge = (y if street is a else x) + sign * across.half_width
            near, far = (edge + sign * distance for distance in CROSSING_M)
            crossings.append(self._band(street, near, far))
            offsets = np.arange(-street.half_width + 0.75, street.half_width - 0.05, 1.1)
            start, end = ([street.point(at, offset) for offset in offsets] for at in (near, far))
            paints += self._bars(start, end, 0.55, WHITE)
            side, stop = _approach_side(street, sign), edge + sign * STOP_LINE_M
            kerb = side * (street.lanes * street.lane_m + street.bike_m)
            paints += self._bars([street.point(stop, side * 0.15)], [street.point(stop, kerb)], 0.4, WHITE)
        return GroundPiece(tuple(paints), roads=(self.city.bend(outline),), crossings=tuple(crossings))

    def _make_stretch(self, axis: int, index: int, cross: int) -> GroundPiece:
        """A street between two junctions: asphalt from centre to centre, lines between the stop lines."""
        street = self.city.street(axis, index)
        start, end = (self.city.street(1 - axis, k).position for k in (cross, cross + 1))
        low, high = self.city.between_stop_lines(axis, index, cross)
        paints = [GroundPaint(self._band(street, start, end), ASPHALT)]
        boundaries = []
        lanes_edge = street.lanes * street.lane_m
        for side in (-1, 1):
            if street.painted_bike:
                lane = self._band(street, low, high, side * lanes_edge, side * (lanes_edge + street.bike_m))
                paints.append(GroundPaint(lane, BIKE_LANE))
            if street.parking_m:
                inner = lanes_edge + street.bike_m
                lane = self._band(street, low, high, side * inner, side * street.half_width)
                paints.append(GroundPaint(lane, PARKING))
            for offset, color, dash in self._lines(street):
                boundaries.append(self.city.bend(self._line(street, low, high, side * offset)))
                length, step = (dash, dash * 2.5) if dash else (4.0, 4.0)
                starts = np.arange(low, high, step)
                ends = [street.point(min(at + length, high), side * offset) for at in starts]
                paints += self._bars([street.point(at, side * offset) for at in starts], ends, LINE_M, color)
        paints += self._marks(street, low, high)
        return GroundPiece(tuple(paints), (self._band(street, start, end),), tuple(boundaries))

    def _lines(self, street: Street) -> Iterator[tuple[float, Color, float]]:
        """The lines right of the centre: offset in metres, colour, dash length in metres (0: solid)."""
        yield (0.16 if street.lanes > 1 else 0.0), YELLOW, 0.0 if street.lanes > 1 else 3.0
        for lane in range(1, street.lanes):
            yield lane * street.lane_m, WHITE, 3.0
        yield street.lanes * street.lane_m, WHITE, 0.0
        if street.parking_m:
            yield street.lanes * street.lane_m + street.bike_m, WHITE, 0.0

    def _marks(self, street: Street, low: float, high: float) -> Iterator[GroundPaint]:
        """Arrows before the stop lines, patches and manhole covers."""
        rng = self.city.stream("marks", street.axis, street.index, int(low))
        for sign, stop in ((1, low), (-1, high)):
            side = _approach_side(street, sign)
            for lane in range(street.lanes):
                offset = side * street.lane_offset(lane)
                for at in (stop + sign * 5.0, stop + sign * 17.0):
                    yield from self._bars(
                        [street.point(at, offset)], [street.point(at + sign * 2.2, offset)], 0.16, WHITE
                    )
                    tip, sides = street.point(at - sign * 1.1, offset), (offset + 0.42, offset - 0.42)
                    yield GroundPaint(self.city.bend([tip, *(street.point(at, side) for side in sides)]), WHITE)
        for _ in range(rng.poisson(5)):
            at, offset = rng.uniform(low, high), rng.uniform(-1, 1) * (street.half_width - 1.5)
            size = rng.uniform(0.5, 3.5), rng.uniform(0.3, 1.2)
            tone = int(rng.choice([70, 74, 98]))
            yield GroundPaint(self._band(street, at, at + size[0], offset, offset + size[1]), (tone, tone, tone + 2))
        for _ in range(3):
            at, offset = rng.uniform(low, high), rng.uniform(-1, 1) * (street.half_width - 2)
            angle = np.linspace(0, 2 * np.pi, 14)[:-1]
            cover = np.array(street.point(at, offset)) + 0.36 * np.stack([np.cos(angle), np.sin(angle)], -1)
            yield GroundPaint(self.city.bend(cover), (58, 56, 55))

    def _line(self, street: Street, start: float, end: float, offset: float) -> Array:
        return along(street.point(start, offset), street.point(end, offset))

    def _band(
        self, street: Street, start: float, end: float, low: float | None = None, high: float | None = None
    ) -> Array:
        """World outline (P, 2) of a strip of a street. low, high: offsets of its edges; default: the kerbs."""
        low = -street.half_width if low is None else low
        high = street.half_width if high is None else high
        edges = self._line(street, start, end, low), self._line(street, start, end, high)[::-1]
        return self.city.bend(np.concatenate(edges))

    def _bars(self, starts: ArrayLike, ends: ArrayLike, width: float, color: Color) -> list[GroundPaint]:
        """Painted lines from plan points (L, 2) to plan points (L, 2). width: metres."""
        a, b = np.asarray(starts, dtype=np.float64), np.asarray(ends, dtype=np.float64)
        way = b - a
        normal = np.stack([-way[:, 1], way[:, 0]], -1) / np.linalg.norm(way, axis=1, keepdims=True) * width / 2
        corners = self.city.bend(np.stack([a + normal, b + normal, b - normal, a - normal], axis=1))
        return [GroundPaint(outline, color, width) for outline in corners]


def _approach_side(street: Street, sign: int) -> int:
    """The sign of the offset of the lanes that lead to a junction. sign: +1 where the stretch begins there, else -1."""
    return sign if street.axis == 0 else -sign


def _junction_outline(x: float, y: float, reach_x: float, reach_y: float) -> Array:
    """Plan outline (24, 2) of a junction, counter-clockwise: a cross whose inner corners have the radius CORNER_M.

    x, y: centre. reach_x, reach_y: from the centre to the ends of its arms, metres.
    """
    points = []
    for sx, sy in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        sweep = np.linspace(0, np.pi / 2, 6)[:: sx * sy]
        points.append(
            np.stack([x + sx * (reach_x - CORNER_M * np.sin(sweep)), y + sy * (reach_y - CORNER_M * np.cos(sweep))], -1)
        )
    return np.concatenate(points)


SUBPIXEL_BITS = 4  # fractional bits of polygon corners in OpenCV
LEVELS = 6  # mip levels; each has half the resolution of the one before
ROUGH_SIZE = 256


@dataclass(frozen=True)
class GroundTexture:
    """A square of the ground in the world frame, rows along y."""

    texels: NDArray[np.uint8]  # (K, 3) square root of linear RGB, 0 to 255; all levels, the finest first
    rough: NDArray[np.float32]  # (256, 256) made by `roughness`
    offsets: NDArray[np.int64]  # (LEVELS,) index of the first texel of each level
    origin: tuple[float, float]  # x and y of the first texel's corner, metres
    texel_m: float  # size of a texel of the finest level
    size: int  # texels along a side of the finest level, a multiple of 2^(LEVELS - 1)


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
    lines: list[tuple[str, BaseGeometry]] = [(BOUNDARY, roads.boundary)]
    for piece in pieces:
        lines += [(DIVIDER, LineString(moved(bev_from_world, line))) for line in piece.lane_boundaries]
        lines += [(CROSSING, Polygon(moved(bev_from_world, outline)).boundary) for outline in piece.crossings]
    return lines_in_area(lines)
