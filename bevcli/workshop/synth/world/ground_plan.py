"""Paint on the ground: roads, lane lines, crossings and pavements, as polygons in the world frame.

The ground texture and the ground truth map are both drawn from these polygons.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from bevcli.geometry.transforms import Array
from bevcli.workshop.synth.assets.paint import Color
from bevcli.workshop.synth.world.city import (
    CORNER_M,
    CROSSING_M,
    STOP_LINE_M,
    CityPlan,
    Street,
    along,
    rounded_rectangle,
)

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
    """A polygon of one colour.

    Attributes:
        outline: (P, 2) world, metres.
        color: sRGB.
        width_m: width of a line, metres; infinite for areas. Textures coarser than twice the width leave it out.
    """

    outline: Array
    color: Color
    width_m: float = float("inf")


@dataclass(frozen=True)
class GroundPiece:
    """The ground of one block, junction or stretch of street, in the world frame, metres.

    Attributes:
        paints: polygons in the order of painting.
        roads: polygons (P, 2) of the drivable road.
        lane_boundaries: polylines (P, 2).
        crossings: polygons (P, 2) of pedestrian crossings.
    """

    paints: tuple[GroundPaint, ...]
    roads: tuple[Array, ...] = ()
    lane_boundaries: tuple[Array, ...] = ()
    crossings: tuple[Array, ...] = ()


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
        """The kerb, the pavement with its joints, and the land behind it."""
        city, block = self.city, self.city.block(column, row)
        (x0, y0), (x1, y1) = block.low, block.high
        outline = city.bend(rounded_rectangle(block.low, block.high, CORNER_M))
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
        """The area where two streets meet, with its crossings and stop lines."""
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
        before, after = self.city.street(1 - axis, cross), self.city.street(1 - axis, cross + 1)
        start, end = before.position, after.position
        low = start + before.half_width + STOP_LINE_M
        high = end - after.half_width - STOP_LINE_M
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
                for back in (5.0, 17.0):
                    yield from self._arrow(street, stop + sign * back, side * street.lane_offset(lane), sign)
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

    def _arrow(self, street: Street, at: float, offset: float, sign: int) -> Iterator[GroundPaint]:
        yield from self._bars([street.point(at, offset)], [street.point(at + sign * 2.2, offset)], 0.16, WHITE)
        head = [street.point(at - sign * 1.1, offset), street.point(at, offset + 0.42), street.point(at, offset - 0.42)]
        yield GroundPaint(self.city.bend(head), WHITE)

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
    """The sign of the offset of the lanes that lead to a junction.

    sign: +1 where the stretch begins at the junction, -1 where it ends there, along the street's axis.
    """
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
