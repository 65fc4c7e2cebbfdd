"""The city's plan: an unlimited grid of streets and the blocks between them; and the routes of vehicles through it.

There are two frames. In plan coordinates (metres) streets are straight: those of axis 0 are parallel to x, those of
axis 1 to y. `CityPlan.bend` maps plan points to the world frame, where streets are curved and the grid is rotated by
a random angle. Every street and block has random numbers of its own, so the plan does not depend on the order of the
calls.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d

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
    """Cross-section of a street, the same on both sides of its centre line."""

    axis: int  # 0 for a street parallel to plan x, 1 for plan y
    index: int  # number of the street among those of its axis
    position: float  # plan coordinate of the centre line: y for axis 0, x for axis 1, metres
    lanes: int  # number of lanes in each direction
    lane_m: float  # width of a lane, metres
    bike_m: float  # width of the bicycle lane, right of the other lanes, metres
    parking_m: float  # width of the parking lane, metres; 0 for none
    sidewalk_m: float  # width of the pavement, metres
    trees: bool  # whether trees stand along the street
    painted_bike: bool  # whether the bicycle lane has a colour of its own

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
    """The land between four streets, in plan coordinates."""

    column: int  # index of the street on its west side
    row: int  # index of the street on its south side
    low: tuple[float, float]  # south-west corner of the kerb, metres
    high: tuple[float, float]  # north-east corner of the kerb, metres
    sidewalks: tuple[float, float, float, float]  # widths on the south, east, north and west side, metres

    @property
    def kerb(self) -> Array:
        """(P, 2) outline of its kerb stones."""
        return rounded_rectangle(self.low, self.high, CORNER_M)

    def inside(self, margin: float = 0.0) -> tuple[Array, Array]:
        """South-west and north-east corner (2,) of the land behind the pavements, `margin` metres from them."""
        south, east, north, west = self.sidewalks
        return np.array(self.low) + (west, south) + margin, np.array(self.high) - (east, north) - margin


class Neighbourhood(NamedTuple):
    """A part of the city."""

    blocks: list[tuple[int, int]]  # column and row
    nodes: list[tuple[int, int]]  # column and row of each junction
    stretches: list[tuple[int, int, int]]  # axis and index of the street, index of the street that crosses it first


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

    def street_at(self, node: tuple[int, int], direction: int) -> Street:
        """The street through a junction (column, row) in a direction (index into DIRECTIONS)."""
        return self.street(0, node[1]) if direction % 2 == 0 else self.street(1, node[0])

    def between_stop_lines(self, axis: int, index: int, cross: int) -> tuple[float, float]:
        """Positions of the stop lines at both ends of a stretch, metres. cross: the street that crosses it first."""
        before, after = self.street(1 - axis, cross), self.street(1 - axis, cross + 1)
        low = before.position + before.half_width + STOP_LINE_M
        return low, after.position - after.half_width - STOP_LINE_M

    def node_center(self, node: tuple[int, int]) -> Array:
        """Plan point (2,) at the centre of a junction (column, row)."""
        return np.array([self.street(1, node[0]).position, self.street(0, node[1]).position])

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


STEP_M = 0.25  # distance between the points of a route
SMOOTHING_M = 1.2  # standard deviation of the smoothing, so that yaw rates change gradually
LATERAL_ACCELERATION = 2.2  # m/s², limit in curves
BRAKING = 1.7  # m/s², deceleration before curves
DIRECTIONS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)], dtype=np.float64)  # east, north, west, south


@dataclass(frozen=True)
class JunctionPass:
    """One junction on a route."""

    node: tuple[int, int]  # column and row of the junction
    direction: int  # index into DIRECTIONS on the approach
    turn: int  # -1 right, 0 straight on, 1 left
    stop: float  # route position of the stop line, metres
    leave: float  # route position behind the crossing on the far side, metres


@dataclass(frozen=True)
class Line:
    """A line of straight pieces."""

    points: Array  # (P, 2) metres

    @cached_property
    def positions(self) -> Array:
        """(P,) distance of each point from the start, along the line, metres."""
        return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(self.points, axis=0), axis=1))])

    def at(self, position: ArrayLike) -> Array:
        """Points (..., 2) at positions (...,) in metres along the line."""
        at = np.asarray(position, dtype=np.float64)
        return np.stack([np.interp(at, self.positions, self.points[:, k]) for k in (0, 1)], -1)


@dataclass(frozen=True)
class Route(Line):
    """The path of a vehicle, in the world frame."""

    yaws: Array  # (P,) headings, radians, unwrapped
    speed_limits: Array  # (P,) m/s
    passes: tuple[JunctionPass, ...]  # the junctions, in order

    def yaw_at(self, position: ArrayLike) -> Array:
        """Heading (...,) in radians."""
        return np.interp(np.asarray(position, dtype=np.float64), self.positions, self.yaws)


def right_of(direction: int) -> Array:
    """Unit vector (2,) to the right of a direction (index into DIRECTIONS)."""
    return DIRECTIONS[(direction - 1) % 4]


def _draw_turn(rng: np.random.Generator, street: Street, lane: int, straight_on: float, bicycle: bool) -> int:
    """Draw a turn that is allowed from the lane of a street; a bicycle goes straight on or turns right."""
    if bicycle:
        return 0 if rng.random() < 0.7 else -1
    # Left turns are rarer: they block the lane.
    turns = [1, -1, -1] if street.lanes == 1 else ([1] if lane == 0 else [-1])
    return 0 if rng.random() < straight_on else turns[int(rng.integers(len(turns)))]


def build_route(
    city: CityPlan,
    rng: np.random.Generator,
    node: tuple[int, int],
    direction: int,
    lane: int,
    before: float,
    length: float,
    speed: float,
    straight_on: float = 0.6,
    bicycle: bool = False,
) -> Route:
    """Build a route with random turns.

    node: the first junction ahead. direction: index into DIRECTIONS of the approach to it. lane: of the street, 0 the
    innermost. before: distance from the start to the centre of the junction, metres.
    length: least length, metres. speed: limit on straight road, m/s. straight_on: share of junctions without a turn,
    where it is not a bicycle. bicycle: whether it keeps right of the lanes, and never turns left.
    """
    street = city.street_at(node, direction)
    offset = street.lane_offset(lane, bicycle)
    at = city.node_center(node) - DIRECTIONS[direction] * before + right_of(direction) * offset
    corners, marks, travelled = [at[None]], [], 0.0
    while travelled < length:
        turn = _draw_turn(rng, street, lane, straight_on, bicycle)
        center, cross = city.node_center(node), city.street_at(node, direction + 1)
        after = (direction + turn) % 4
        following = (node[0] + int(DIRECTIONS[after][0]), node[1] + int(DIRECTIONS[after][1]))
        street = city.street_at(following, after)
        lane = min(lane, street.lanes - 1) if turn == 0 else (0 if turn > 0 else street.lanes - 1)
        new_offset = street.lane_offset(lane, bicycle)
        corner = center + right_of(direction) * offset
        if turn != 0:
            corner = corner + DIRECTIONS[direction] * (right_of(after) @ DIRECTIONS[direction]) * new_offset
        radius = cross.half_width + turn * new_offset + (1.5 if turn < 0 else 0.0)
        begin, end = corner - DIRECTIONS[direction] * radius, corner + DIRECTIONS[after] * radius
        stop = _lane_point(center, direction, offset, -(cross.half_width + STOP_LINE_M))
        across = city.street_at(node, after + 1)
        leave = _lane_point(center, after, new_offset, across.half_width + CROSSING_M[1])
        marks.append((node, direction, turn, stop, leave))
        piece = np.stack([begin, end])
        if turn != 0:  # a quarter of an ellipse, tangent to both lines
            middle, angle = begin + end - corner, np.linspace(0, np.pi / 2, 17)[:, None]
            piece = middle + (begin - middle) * np.cos(angle) + (end - middle) * np.sin(angle)
        corners.append(piece)
        travelled += float(np.linalg.norm(piece[0] - at)) + radius * 1.6
        at, node, direction, offset = piece[-1], following, after, new_offset
    corners.append((at + DIRECTIONS[direction] * 40)[None])
    return _finish(city, np.concatenate(corners), marks, speed)


def _lane_point(center: Array, direction: int, offset: float, ahead: float) -> Array:
    """Plan point on a lane at a junction: `offset` metres right of its centre and `ahead` metres behind it."""
    return center + right_of(direction) * offset + DIRECTIONS[direction] * ahead


def _finish(city: CityPlan, corners: Array, marks: list, speed: float) -> Route:
    """Sample a plan line (C, 2), map it to the world, smooth it, and find the route positions of the marks.

    marks: of each junction: node, direction, turn, and the plan points of stop and leave.
    """
    line = Line(corners)
    plan = line.at(np.arange(0, line.positions[-1], STEP_M))
    points = gaussian_filter1d(city.bend(plan), SMOOTHING_M / STEP_M, axis=0, mode="nearest")
    positions = Line(points).positions
    way = np.gradient(points, axis=0)
    yaws = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
    curvature = np.abs(np.gradient(yaws) / np.maximum(np.gradient(positions), 1e-6))
    squared = np.minimum(speed**2, LATERAL_ACCELERATION / np.maximum(curvature, 1e-4))
    falling = squared + 2 * BRAKING * positions  # the limits fall before curves so that BRAKING is enough
    limits = np.sqrt(np.minimum.accumulate(falling[::-1])[::-1] - 2 * BRAKING * positions)
    passes, start = [], 0
    for node, direction, turn, *plan_points in marks:
        reached = []
        for point in plan_points:
            window = plan[start : start + int(160 / STEP_M)]
            start += int(np.argmin(np.linalg.norm(window - point, axis=1)))
            reached.append(float(positions[start]))
        passes.append(JunctionPass(node, direction, turn, *reached))
    return Route(points, yaws, limits, tuple(passes))
