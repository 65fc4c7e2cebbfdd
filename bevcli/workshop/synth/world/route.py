"""Routes: the smooth line that a vehicle follows, with its speed limits and the junctions on it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter1d

from bevcli.geometry.transforms import Array
from bevcli.workshop.synth.world.city import CROSSING_M, STOP_LINE_M, CityPlan, Street

STEP_M = 0.25  # distance between the points of a route
SMOOTHING_M = 1.2  # standard deviation of the smoothing, so that yaw rates change gradually
LATERAL_ACCELERATION = 2.2  # m/s², limit in curves
BRAKING = 1.7  # m/s², deceleration before curves
DIRECTIONS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)], dtype=np.float64)  # east, north, west, south


@dataclass(frozen=True)
class JunctionPass:
    """One junction on a route.

    Attributes:
        node: column and row of the junction.
        direction: index into DIRECTIONS on the approach.
        turn: -1 right, 0 straight on, 1 left.
        stop: route position of the stop line, metres.
        leave: route position behind the crossing on the far side, metres.
    """

    node: tuple[int, int]
    direction: int
    turn: int
    stop: float
    leave: float


@dataclass(frozen=True)
class Route:
    """The path of a vehicle.

    Attributes:
        points: (P, 2) world, metres.
        positions: (P,) distance of each point from the start, along the route, metres.
        yaws: (P,) headings, radians, unwrapped.
        speed_limits: (P,) m/s.
        passes: the junctions, in order.
    """

    points: Array
    positions: Array
    yaws: Array
    speed_limits: Array
    passes: tuple[JunctionPass, ...]

    def at(self, position: ArrayLike) -> Array:
        """World points (..., 2) at positions (...,) in metres along the route."""
        return points_at(position, self.points, self.positions)

    def yaw_at(self, position: ArrayLike) -> Array:
        """Heading (...,) in radians."""
        return np.interp(np.asarray(position, dtype=np.float64), self.positions, self.yaws)


def street_of(city: CityPlan, node: tuple[int, int], direction: int) -> Street:
    """The street through a junction in a direction (index into DIRECTIONS)."""
    return city.street(0, node[1]) if direction % 2 == 0 else city.street(1, node[0])


def node_center(city: CityPlan, node: tuple[int, int]) -> Array:
    """Plan point (2,) at the centre of a junction."""
    return np.array([city.street(1, node[0]).position, city.street(0, node[1]).position])


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
    street = street_of(city, node, direction)
    offset = street.lane_offset(lane, bicycle)
    at = node_center(city, node) - DIRECTIONS[direction] * before + right_of(direction) * offset
    corners, marks, travelled = [at[None]], [], 0.0
    while travelled < length:
        turn = _draw_turn(rng, street, lane, straight_on, bicycle)
        center, cross = node_center(city, node), street_of(city, node, direction + 1)
        after = (direction + turn) % 4
        following = (node[0] + int(DIRECTIONS[after][0]), node[1] + int(DIRECTIONS[after][1]))
        street = street_of(city, following, after)
        lane = min(lane, street.lanes - 1) if turn == 0 else (0 if turn > 0 else street.lanes - 1)
        new_offset = street.lane_offset(lane, bicycle)
        corner = center + right_of(direction) * offset
        if turn != 0:
            corner = corner + DIRECTIONS[direction] * (right_of(after) @ DIRECTIONS[direction]) * new_offset
        radius = cross.half_width + turn * new_offset + (1.5 if turn < 0 else 0.0)
        begin, end = corner - DIRECTIONS[direction] * radius, corner + DIRECTIONS[after] * radius
        stop = _lane_point(center, direction, offset, -(cross.half_width + STOP_LINE_M))
        across = street_of(city, node, after + 1)
        leave = _lane_point(center, after, new_offset, across.half_width + CROSSING_M[1])
        marks.append((node, direction, turn, stop, leave))
        piece = _arc(begin, corner, end) if turn != 0 else np.stack([begin, end])
        corners.append(piece)
        travelled += float(np.linalg.norm(piece[0] - at)) + radius * 1.6
        at, node, direction, offset = piece[-1], following, after, new_offset
    corners.append((at + DIRECTIONS[direction] * 40)[None])
    return _finish(city, np.concatenate(corners), marks, speed)


def _lane_point(center: Array, direction: int, offset: float, ahead: float) -> Array:
    """Plan point on a lane at a junction: `offset` metres right of its centre and `ahead` metres behind it."""
    return center + right_of(direction) * offset + DIRECTIONS[direction] * ahead


def _arc(begin: Array, corner: Array, end: Array) -> Array:
    """(17, 2) quarter of an ellipse from begin to end, tangent to the lines from begin and end to the corner."""
    center = begin + end - corner
    angle = np.linspace(0, np.pi / 2, 17)[:, None]
    return center + (begin - center) * np.cos(angle) + (end - center) * np.sin(angle)


def _finish(city: CityPlan, corners: Array, marks: list, speed: float) -> Route:
    """Sample a plan line (C, 2), map it to the world, smooth it, and find the route positions of the marks.

    marks: of each junction: node, direction, turn, and the plan points of stop and leave.
    """
    along_corners = distances_along(corners)
    samples = np.arange(0, along_corners[-1], STEP_M)
    plan = points_at(samples, corners, along_corners)
    points = gaussian_filter1d(city.bend(plan), SMOOTHING_M / STEP_M, axis=0, mode="nearest")
    positions = distances_along(points)
    way = np.gradient(points, axis=0)
    yaws = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
    limits = _speed_limits(positions, yaws, speed)
    passes, start = [], 0
    for node, direction, turn, *places in marks:
        found = []
        for place in places:
            window = plan[start : start + int(160 / STEP_M)]
            start += int(np.argmin(np.linalg.norm(window - place, axis=1)))
            found.append(float(positions[start]))
        passes.append(JunctionPass(node, direction, turn, *found))
    return Route(points, positions, yaws, limits, tuple(passes))


def distances_along(points: Array) -> Array:
    """(P,) distance of each point (P, 2) of a line from its start, along the line."""
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def points_at(places: ArrayLike, points: Array, positions: Array) -> Array:
    """Points (..., 2) of a line at places (...,) along it. points: (P, 2) with positions (P,) along the line."""
    at = np.asarray(places, dtype=np.float64)
    return np.stack([np.interp(at, positions, points[:, k]) for k in (0, 1)], -1)


def _speed_limits(positions: Array, yaws: Array, speed: float) -> NDArray[np.float64]:
    """(P,) m/s: the limits of the curves, lowered before them so that BRAKING is enough."""
    curvature = np.abs(np.gradient(yaws) / np.maximum(np.gradient(positions), 1e-6))
    squared = np.minimum(speed**2, LATERAL_ACCELERATION / np.maximum(curvature, 1e-4))
    falling = squared + 2 * BRAKING * positions
    return np.sqrt(np.minimum.accumulate(falling[::-1])[::-1] - 2 * BRAKING * positions)
