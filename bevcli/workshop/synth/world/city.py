"""The city's plan: an unlimited grid of streets and the blocks between them.

There are two frames. In plan coordinates (metres) streets are straight: those of axis 0 are parallel to x, those of
axis 1 to y. `CityPlan.bend` maps plan points to the world frame, where streets are curved and the grid is rotated by
a random angle. Every street and block has random numbers of its own, so the plan does not depend on the order of the
calls.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bevcli.geometry.transforms import Array

KERB_M = 0.15  # height of kerbs
CORNER_M = 5.0  # radius of the kerb at a junction
CROSSING_M = (1.5, 5.0)  # extent of a pedestrian crossing, measured from the edge of the junction
STOP_LINE_M = 6.2  # from the edge of the junction to the stop line
BICYCLE_OFFSET_M = 0.5  # from the edge of the outermost lane to the line that bicycles follow
SIDE_STEP_M, LINE_STEP_M = 6.0, 4.0  # distances between the points of outlines and lines, so that they can be bent

Landuse = Literal["houses", "park", "site"]
Corner = Array | tuple[float, float]


@dataclass(frozen=True)
class Street:
    """Cross-section of a street, the same on both sides of its centre line.

    Attributes:
        axis: 0 for a street parallel to plan x, 1 for plan y.
        index: number of the street among those of its axis.
        position: plan coordinate of the centre line: y for axis 0, x for axis 1, metres.
        lanes: number of lanes in each direction.
        lane_m: width of a lane, metres.
        bike_m: width of the bicycle lane, right of the other lanes, metres.
        parking_m: width of the parking lane, metres; 0 for none.
        sidewalk_m: width of the pavement, metres.
        trees: whether trees stand along the street.
        painted_bike: whether the bicycle lane has a colour of its own.
    """

    axis: int
    index: int
    position: float
    lanes: int
    lane_m: float
    bike_m: float
    parking_m: float
    sidewalk_m: float
    trees: bool
    painted_bike: bool

    @property
    def half_width(self) -> float:
        """From the centre line to the kerb, metres."""
        return self.lanes * self.lane_m + self.bike_m + self.parking_m

    def point(self, position: float, offset: float = 0.0) -> tuple[float, float]:
        """Plan point at a position along the street, `offset` metres from its centre line (towards +y or +x)."""
        return (position, self.position + offset) if self.axis == 0 else (self.position + offset, position)

    def lane_offset(self, lane: int, bicycle: bool = False) -> float:
        """From the centre line to the middle of a lane, or to the line of bicycles, metres. Lane 0 is the innermost."""
        return self.lanes * self.lane_m + BICYCLE_OFFSET_M if bicycle else self.lane_m * (lane + 0.5)


@dataclass(frozen=True)
class Block:
    """The land between four streets, in plan coordinates.

    Attributes:
        column: index of the street on its west side.
        row: index of the street on its south side.
        low: south-west corner of the kerb, metres.
        high: north-east corner of the kerb, metres.
        sidewalks: widths of the pavements on the south, east, north and west side, metres.
    """

    column: int
    row: int
    low: tuple[float, float]
    high: tuple[float, float]
    sidewalks: tuple[float, float, float, float]

    def inside(self, margin: float = 0.0) -> tuple[Array, Array]:
        """South-west and north-east corner (2,) of the land behind the pavements, `margin` metres from them."""
        south, east, north, west = self.sidewalks
        return np.array(self.low) + (west, south) + margin, np.array(self.high) - (east, north) - margin


class Neighbourhood(NamedTuple):
    """A part of the city.

    Attributes:
        blocks: column and row of each block.
        nodes: column and row of each junction.
        stretches: axis and index of the street of each stretch, and index of the street that crosses it at the
            beginning.
    """

    blocks: list[tuple[int, int]]
    nodes: list[tuple[int, int]]
    stretches: list[tuple[int, int, int]]


class CityPlan:
    """The plan of one seed. It has no limits: streets and blocks exist at every index, negative ones included."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        rng = self.stream("bend")
        angle = rng.uniform(0, 2 * np.pi)
        self._cosine, self._sine = float(np.cos(angle)), float(np.sin(angle))
        self._amplitude = rng.uniform(1.0, 7.0, 2)
        self._period = rng.uniform(170, 280, 2)
        self._phase = rng.uniform(0, 2 * np.pi, 2)
        self.street = lru_cache(maxsize=None)(self._street)
        self._position = lru_cache(maxsize=None)(self._make_position)

    def stream(self, purpose: str, *indices: int) -> np.random.Generator:
        """A random number generator for one purpose and one place, independent of all others."""
        name = int.from_bytes(purpose.encode()[:12].ljust(12, b"."), "big")
        entropy = [self.seed, name, *(index + 2**20 for index in indices)]
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence(entropy)))

    def _sway(self, points: Array) -> Array:
        """Shift (..., 2) of plan points (..., 2) that makes the streets curved, metres."""
        return self._amplitude * np.sin(2 * np.pi * points[..., ::-1] / self._period + self._phase)

    def bend(self, points: ArrayLike) -> Array:
        """Map plan points (..., 2) to world points (..., 2)."""
        p = np.asarray(points, dtype=np.float64)
        x, y = np.moveaxis(p + self._sway(p), -1, 0)
        return np.stack([self._cosine * x - self._sine * y, self._sine * x + self._cosine * y], axis=-1)

    def unbend(self, points: ArrayLike) -> Array:
        """Map world points (..., 2) to plan points (..., 2). The inverse of `bend`, by fixed-point iteration."""
        x, y = np.moveaxis(np.asarray(points, dtype=np.float64), -1, 0)
        target = np.stack([self._cosine * x + self._sine * y, -self._sine * x + self._cosine * y], axis=-1)
        p = target
        for _ in range(12):
            p = target - self._sway(p)
        return p

    def heading(self, point: ArrayLike, direction: ArrayLike) -> float:
        """World yaw of a plan direction (2,) at a plan point (2,), radians."""
        p, d = np.asarray(point, dtype=np.float64), np.asarray(direction, dtype=np.float64)
        ahead, behind = self.bend(p + 0.05 * d), self.bend(p - 0.05 * d)
        return float(np.arctan2(ahead[1] - behind[1], ahead[0] - behind[0]))

    def _make_position(self, axis: int, index: int) -> float:
        if index == 0:
            return 0.0
        previous = index - 1 if index > 0 else index + 1
        gap = self.stream("spacing", axis, max(index, previous)).uniform(62, 108)
        return self._position(axis, previous) + (gap if index > 0 else -gap)

    def _street(self, axis: int, index: int) -> Street:
        rng = self.stream("street", axis, index)
        lanes = int(rng.choice([1, 2], p=[0.6, 0.4]))
        return Street(
            axis, index, self._position(axis, index), lanes, float(rng.uniform(3.3, 3.6)), 1.7,
            2.6 if rng.random() < 0.75 else 0.0, float(rng.uniform(4.0, 6.0)), bool(rng.random() < 0.75),
            bool(rng.random() < 0.6),
        )  # fmt: skip

    def block(self, column: int, row: int) -> Block:
        """The block east of street `column` of axis 1 and north of street `row` of axis 0."""
        west, east = self.street(1, column), self.street(1, column + 1)
        south, north = self.street(0, row), self.street(0, row + 1)
        return Block(
            column, row,
            (west.position + west.half_width, south.position + south.half_width),
            (east.position - east.half_width, north.position - north.half_width),
            (south.sidewalk_m, east.sidewalk_m, north.sidewalk_m, west.sidewalk_m),
        )  # fmt: skip

    def landuse(self, column: int, row: int) -> Landuse:
        """Use of a block: 70 % houses, 14 % parks, 16 % building sites."""
        share = self.stream("landuse", column, row).random()
        if share < 0.14:
            return "park"
        return "site" if share < 0.30 else "houses"

    def streets_between(self, axis: int, low: float, high: float) -> range:
        """Indices of the streets of an axis that overlap the interval from low to high (plan coordinates, metres)."""
        first, last = self.street(axis, self.below(axis, low)), self.street(axis, self.below(axis, high) + 1)
        start = first.index if first.position + first.half_width >= low else first.index + 1
        return range(start, last.index + 1 if last.position - last.half_width <= high else last.index)

    def around(self, center: ArrayLike, reach_m: float) -> Neighbourhood:
        """The streets and blocks within `reach_m` metres, along x and y, of a world point (2,)."""
        x, y = self.unbend(center)
        columns = self.streets_between(1, x - reach_m, x + reach_m)
        rows = self.streets_between(0, y - reach_m, y + reach_m)
        block_columns, block_rows = (range(streets.start - 1, streets.stop) for streets in (columns, rows))
        return Neighbourhood(
            list(product(block_columns, block_rows)),
            list(product(columns, rows)),
            [*product((1,), columns, block_rows), *product((0,), rows, block_columns)],
        )

    def below(self, axis: int, position: float) -> int:
        """Index of the last street of an axis whose centre line is not beyond a plan coordinate in metres."""
        index = round(position / 85)
        while self._position(axis, index) > position:
            index -= 1
        while self._position(axis, index + 1) < position:
            index += 1
        return index


def side_of(low: Corner, high: Corner, side: int) -> tuple[Array, Array, Array, float]:
    """Start (2,), unit vector along it (2,), inward unit vector (2,) and length of a side of a rectangle.

    low, high: its south-west and north-east corner. side: 0 south, 1 east, 2 north, 3 west.
    """
    (x0, y0), (x1, y1) = low, high
    start, end = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], dtype=np.float64)[[side, (side + 1) % 4]]
    length = float(np.hypot(*(end - start)))
    inward = np.array([(0, 1), (-1, 0), (0, -1), (1, 0)][side], dtype=np.float64)
    return start, (end - start) / length, inward, length


def rounded_rectangle(low: Corner, high: Corner, radius: float) -> Array:
    """(P, 2) counter-clockwise outline with round corners and with points about every SIDE_STEP_M on its sides."""
    (x0, y0), (x1, y1) = low, high
    radius = min(radius, (x1 - x0) / 2, (y1 - y0) / 2)
    centers = [(x1 - radius, y0 + radius, -np.pi / 2), (x1 - radius, y1 - radius, 0.0),
               (x0 + radius, y1 - radius, np.pi / 2), (x0 + radius, y0 + radius, np.pi)]  # fmt: skip
    corners = []
    for cx, cy, start in centers:
        angle = start + np.linspace(0, np.pi / 2, 7)
        corners.append(np.stack([cx + radius * np.cos(angle), cy + radius * np.sin(angle)], -1))
    pieces = []
    for this, following in zip(corners, corners[1:] + corners[:1], strict=True):
        pieces.append(this)
        count = max(int(np.linalg.norm(following[0] - this[-1]) / SIDE_STEP_M), 1)
        pieces.append(this[-1] + (following[0] - this[-1]) * (np.arange(1, count) / count)[:, None])
    return np.concatenate(pieces)


def along(start: ArrayLike, end: ArrayLike) -> Array:
    """(P, 2) points from start to end, at most LINE_STEP_M apart, both ends included."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    count = max(int(np.ceil(np.linalg.norm(b - a) / LINE_STEP_M)), 1)
    return a + (b - a) * np.linspace(0, 1, count + 1)[:, None]
