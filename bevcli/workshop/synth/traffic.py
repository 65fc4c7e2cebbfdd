"""Traffic: signals, vehicles that keep their distance, obey signals and give way, and the states of actors."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from bevcli.geometry.ego_motion import GRAVITY
from bevcli.geometry.transforms import Array
from bevcli.jit import njit
from bevcli.workshop.synth.catalog import Assets, Body, draw_body
from bevcli.workshop.synth.city import DIRECTIONS, STOP_LINE_M, CityPlan, JunctionPass, Route, build_route, right_of
from bevcli.workshop.synth.road_users import RIDDEN

Light = Literal["red", "yellow", "green"]
YELLOW_S, CLEARING_S = 1.5, 2.0  # durations of yellow, and of red in all directions
WALK_START_S = 4.5  # people may start to cross until this time after parallel traffic got green


class Signals:
    """The signals of a city. In the cycle of a junction axis 0 has green first, then axis 1.

    first: node and axis of the ego vehicle's approach to its first junction. Its light turns green early in the
    drive, so that the ego vehicle does not wait for the whole drive.
    """

    def __init__(self, city: CityPlan, first: tuple[tuple[int, int], int]) -> None:
        self._city, self._first = city, first
        self._cycle = lru_cache(maxsize=None)(self._make_cycle)

    def _make_cycle(self, node: tuple[int, int]) -> tuple[tuple[float, float], tuple[float, float], float]:
        """For both axes the duration of green and its start in the cycle, and the position at time 0; seconds."""
        rng = self._city.stream("signals", *node)
        greens = (15.0, 10.0) if rng.random() < 0.5 else (10.0, 15.0)
        starts, offset = (0.0, greens[0] + YELLOW_S + CLEARING_S), float(rng.uniform(0, 40))
        if node == self._first[0]:
            offset = starts[self._first[1]] + float(rng.uniform(-3, 11))
        return greens, starts, offset

    def _since_green(self, node: tuple[int, int], axis: int, time_s: float) -> float:
        greens, starts, offset = self._cycle(node)
        return (time_s + offset - starts[axis]) % (sum(greens) + 2 * (YELLOW_S + CLEARING_S))

    def light(self, node: tuple[int, int], axis: int, time_s: float) -> Light:
        """The light for vehicles on a street of this axis."""
        green, since = self._cycle(node)[0][axis], self._since_green(node, axis, time_s)
        if since < green:
            return "green"
        return "yellow" if since < green + YELLOW_S else "red"

    def walk(self, node: tuple[int, int], axis: int, time_s: float) -> bool:
        """True while people may start to cross a street of this axis: shortly after the other axis got green."""
        return self._since_green(node, 1 - axis, time_s) < WALK_START_S


STEP_S = 0.1  # time step of the simulation
LOOK_AHEAD_M, LOOK_STEPS = 42.0, 54  # range of the search for obstacles, and its number of samples
CORRIDOR_M = 1.55  # obstacles nearer than this to the centre of a vehicle's lane block it
COMFORT = 2.0  # m/s², comfortable deceleration
HARDEST = -3.4  # m/s², strongest deceleration


@dataclass(frozen=True)
class Unit:
    """One part of a vehicle: the vehicle itself, its tractor or its trailer."""

    body: Body  # size and looks
    lag: float  # distance from the vehicle's front to the front of this unit, metres


@dataclass(eq=False)
class Vehicle:
    """A vehicle on its route. Its track has every step since it appeared."""

    route: Route
    units: tuple[Unit, ...]  # the vehicle, or tractor and trailer, from front to rear
    front: float  # route position, metres
    speed: float  # m/s
    liveliness: float  # factor on the acceleration, about 1
    bicycle: bool = False
    track: list[tuple[float, float, float]] = field(default_factory=list)  # time (s), front (m), speed (m/s)

    @cached_property
    def length(self) -> float:
        """From the front to the rear, metres."""
        return self.units[-1].lag + float(self.units[-1].body.size_lwh[0])

    def next_pass(self) -> JunctionPass | None:
        """The first junction that the vehicle has not left yet; None where the route has no more."""
        return next((p for p in self.route.passes if self.front < p.leave + self.length), None)

    def body_points(self) -> Array:
        """(B, 2) world points along the vehicle, at most 2.5 m apart, both ends included."""
        count = max(int(np.ceil(self.length / 2.5)) + 1, 2)
        return points_between(self.route.points, self.route.positions, self.front - self.length, self.front, count)


def step(vehicles: list[Vehicle], people: Array, signals: Signals, time_s: float) -> None:
    """Advance all vehicles by STEP_S. people: (H, 2) world points of people on the road."""
    parts = [*(vehicle.body_points() for vehicle in vehicles), people]
    obstacles, owners = np.concatenate(parts), np.repeat([*range(len(vehicles)), -1], [len(part) for part in parts])
    accelerations = [_acceleration(k, vehicles, obstacles, owners, signals, time_s) for k in range(len(vehicles))]
    for vehicle, acceleration in zip(vehicles, accelerations, strict=True):
        faster = max(vehicle.speed + acceleration * STEP_S, 0.0)
        vehicle.front += (vehicle.speed + faster) / 2 * STEP_S
        vehicle.speed = faster
        vehicle.track.append((time_s + STEP_S, vehicle.front, vehicle.speed))


def _acceleration(
    index: int, vehicles: list[Vehicle], obstacles: Array, owners: NDArray, signals: Signals, time_s: float
) -> float:
    """Acceleration in m/s² by the Intelligent Driver Model (IDM): the smallest of free road, obstacle and signal."""
    vehicle, route = vehicles[index], vehicles[index].route
    limit = float(np.interp(vehicle.front, route.positions, route.speed_limits))
    speed, strongest = vehicle.speed, 1.6 * vehicle.liveliness
    free = strongest * (1 - (speed / max(limit, 0.3)) ** 4) if speed <= limit else max(-2.2, (limit - speed) * 2.0)
    corridor = 0.9 if vehicle.bicycle else CORRIDOR_M
    gap, other = _nearest_in_way(route.points, route.positions, vehicle.front, obstacles, owners, index, corridor)
    acceleration = free
    if gap < np.inf:
        lead = 0.0
        if other >= 0:  # the speed counts if the other vehicle drives in about the same direction, within 60 degrees
            yaw = vehicles[other].route.yaw_at(vehicles[other].front)
            lead = vehicles[other].speed if np.cos(route.yaw_at(vehicle.front) - yaw) > 0.5 else 0.0
        acceleration = min(acceleration, _follow(speed, limit, strongest, gap, lead))
    crossing = vehicle.next_pass()
    if crossing is not None and vehicle.front < crossing.stop + 0.5:
        room = crossing.stop - vehicle.front
        needed = speed**2 / (2 * max(room, 0.1))
        if needed < 3.0 and not _may_enter(vehicle, crossing, vehicles, signals, time_s):
            acceleration = min(acceleration, _follow(speed, limit, strongest, room + 1.4, 0.0))
    return float(np.clip(acceleration, HARDEST, strongest))


def _follow(speed: float, limit: float, strongest: float, gap: float, lead_speed: float) -> float:
    """Acceleration (IDM) behind a vehicle at `lead_speed`, `gap` metres ahead: keep a distance of 2 m plus 1.2 s."""
    desired = 2.0 + max(0.0, speed * 1.2 + speed * (speed - lead_speed) / (2 * np.sqrt(strongest * COMFORT)))
    return strongest * (1 - (speed / max(limit, 0.3)) ** 4 - (desired / max(gap, 0.1)) ** 2)


def _may_enter(
    vehicle: Vehicle, crossing: JunctionPass, vehicles: list[Vehicle], signals: Signals, time_s: float
) -> bool:
    """True where the light is green and nobody has priority. Left turns may also start on yellow."""
    light = signals.light(crossing.node, crossing.direction % 2, time_s)
    if light != "green" and (light == "red" or crossing.turn <= 0):
        return False
    return not any(
        _has_priority(other, theirs, vehicle, crossing, light)
        for other in vehicles
        if other is not vehicle and (theirs := other.next_pass()) is not None and theirs.node == crossing.node
    )


def _has_priority(other: Vehicle, theirs: JunctionPass, vehicle: Vehicle, crossing: JunctionPass, light: Light) -> bool:
    """True where the other vehicle has priority: oncoming over left turns, bicycles over right turns not yet begun."""
    if theirs.direction == (crossing.direction + 2) % 4 and crossing.turn == 1 and theirs.turn != 1:
        near = theirs.stop - 15 < other.front < theirs.leave - 5
        waits = other.speed < 0.5 and (light == "yellow" or other.front < theirs.stop - 6)
        return near and (not waits or other.front > theirs.stop + 1)
    if theirs.direction == crossing.direction and other.bicycle != vehicle.bicycle:
        if vehicle.bicycle:
            return theirs.turn == -1 and theirs.stop + 0.5 < other.front < theirs.leave + 2
        return crossing.turn == -1 and theirs.stop - 8 < other.front < theirs.leave
    return False


@njit(nogil=True)
def points_between(points: Array, positions: Array, start: float, end: float, count: int) -> Array:
    """(count, 2) evenly spaced points of a route (P, 2) with positions (P,), from start to end, metres."""
    result = np.empty((count, 2))
    for i in range(count):
        at = start + (end - start) * i / (count - 1)
        k = min(max(int(np.searchsorted(positions, at)) - 1, 0), len(positions) - 2)
        w = min(max((at - positions[k]) / (positions[k + 1] - positions[k]), 0.0), 1.0)
        result[i, 0] = points[k, 0] + w * (points[k + 1, 0] - points[k, 0])
        result[i, 1] = points[k, 1] + w * (points[k + 1, 1] - points[k, 1])
    return result


@njit(nogil=True)
def _nearest_in_way(
    points: Array, positions: Array, front: float, obstacles: Array, owners: NDArray, owner: int, corridor: float
) -> tuple[float, int]:
    """Find the first obstacle ahead on a route.

    points: (P, 2) of the route. positions: (P,) along it, metres. front: start of the search, metres.
    obstacles: (O, 2). owners: (O,) index of the vehicle that an obstacle point belongs to, -1 for people.
    owner: index whose points are ignored. corridor: half the width of the search, metres.
    Returns the distance in metres and the owner; infinity and -1 where the road is free.
    """
    squared = corridor * corridor
    way = points_between(points, positions, front + 0.3, front + LOOK_AHEAD_M, LOOK_STEPS)
    reach = (LOOK_AHEAD_M + 5.0) ** 2
    near = [k for k in range(obstacles.shape[0]) if owners[k] != owner
            and (obstacles[k, 0] - way[0, 0]) ** 2 + (obstacles[k, 1] - way[0, 1]) ** 2 < reach]  # fmt: skip
    for i in range(LOOK_STEPS):
        for k in near:
            dx, dy = obstacles[k, 0] - way[i, 0], obstacles[k, 1] - way[i, 1]
            if dx * dx + dy * dy < squared:
                return max(i * (LOOK_AHEAD_M - 0.3) / (LOOK_STEPS - 1) - 0.4, 0.05), owners[k]
    return np.inf, -1


MOVING_M_S = 0.3  # slower actors have the attribute of a standing one
_DIFFERENCE_S = 0.02  # half the interval of the central differences that give velocities


@dataclass(frozen=True)
class ActorState:
    """An actor at one time."""

    body: Body  # size and looks
    position: Array  # (3,) middle of the bottom, world, metres
    yaw: float  # world, radians
    attribute: str  # nuScenes attribute, such as "vehicle.moving"; empty for classes without attributes
    velocity: Array = field(default_factory=lambda: np.zeros(2))  # (2,) world, m/s
    pose: int = 0  # index of the mesh among the variant's poses; taken modulo their number


@dataclass(frozen=True)
class DrivingActor:
    """One unit of a driving vehicle. Its axles are on the route."""

    vehicle: Vehicle  # after the simulation
    unit: Unit
    track: Array  # (3, T) seconds, route positions of the vehicle's front (metres), speeds (m/s)

    def state(self, time_s: float) -> ActorState | None:
        """The state at a time of the drive in seconds; None before the vehicle appears and after it leaves."""
        first, last = self.track[0, 0], self.track[0, -1]
        if not first <= time_s <= last:
            return None
        center, yaw = self._pose(time_s)
        early, late = max(time_s - _DIFFERENCE_S, first), min(time_s + _DIFFERENCE_S, last)
        velocity = (self._pose(late)[0] - self._pose(early)[0]) / max(late - early, 1e-9)
        attribute = "vehicle.moving" if float(np.hypot(*velocity)) > MOVING_M_S else "vehicle.stopped"
        if self.unit.body.variant.class_name in RIDDEN:
            attribute = "cycle.with_rider"
        return ActorState(self.unit.body, np.array([*center, 0.0]), yaw, attribute, velocity)

    def _pose(self, time_s: float) -> tuple[Array, float]:
        front = interpolated_track(self.track, time_s)
        length = float(self.unit.body.size_lwh[0])
        middle = front - self.unit.lag - length / 2
        route = self.vehicle.route
        rear, fore = points_between(route.points, route.positions, middle - 0.3 * length, middle + 0.3 * length, 2)
        return (rear + fore) / 2, math.atan2(fore[1] - rear[1], fore[0] - rear[0])


def interpolated_track(track: Array, time_s: float) -> float:
    """Route position in metres at a time: cubic Hermite interpolation between the steps of a track (3, T)."""
    times, fronts, speeds = track
    k = min(max(int(times.searchsorted(time_s, side="right")) - 1, 0), len(times) - 2)
    span = times[k + 1] - times[k]
    u = (time_s - times[k]) / span
    a, b, m, n = fronts[k], fronts[k + 1], speeds[k] * span, speeds[k + 1] * span
    return float(
        (2 * u**3 - 3 * u**2 + 1) * a + (u**3 - 2 * u**2 + u) * m + (3 * u**2 - 2 * u**3) * b + (u**3 - u**2) * n
    )


EGO_REAR_AXLE_M = 3.75  # from the front of the ego vehicle to its rear axle, the origin of the ego frame
EGO_SMOOTHING_S = 0.35  # standard deviation of the smoothing of the ego vehicle's speed


@dataclass(frozen=True)
class EgoTrack:
    """The motion of the ego vehicle's rear axle."""

    route: Route  # its route
    track: Array  # (3, T) times (seconds), route positions (metres), speeds (m/s)

    @staticmethod
    def smoothed(ego: Vehicle) -> "EgoTrack":
        """The track of the ego vehicle with its speed smoothed, which limits its acceleration."""
        times, fronts, speeds = np.array(ego.track).T
        soft = gaussian_filter1d(speeds, EGO_SMOOTHING_S / STEP_S, mode="nearest")
        moved = np.concatenate([[0], np.cumsum((soft[1:] + soft[:-1]) / 2 * STEP_S)])
        return EgoTrack(ego.route, np.stack([times, fronts[0] - EGO_REAR_AXLE_M + moved, soft]))

    def pose(self, time_s: float) -> tuple[Array, float]:
        """World point (2,) of the rear axle in metres, and yaw in radians, at a time in seconds."""
        s = interpolated_track(self.track, time_s)
        return self.route.at(s), float(self.route.yaw_at(s))

    def motion(self, time_s: float) -> tuple[Array, Array, Array]:
        """Acceleration with gravity (m/s²), angular rate (rad/s) and velocity (m/s), each (3,), ego frame."""
        h = 0.05
        s = [interpolated_track(self.track, time_s + d) for d in (-h, 0.0, h)]
        speed = (s[2] - s[0]) / (2 * h)
        rate = float(self.route.yaw_at(s[2]) - self.route.yaw_at(s[0])) / (2 * h)
        before, after = np.interp([time_s - h, time_s + h], self.track[0], self.track[2])
        forward = float(after - before) / (2 * h)
        return np.array([forward, speed * rate, GRAVITY]), np.array([0.0, 0.0, rate]), np.array([speed, 0.0, 0.0])


MOVING_LOOKS = {**RIDDEN, "construction_vehicle": ("loader", "backhoe", "crane", "mixer")}
SEMITRAILERS = ("box", "curtain", "container", "tanker", "flatbed")


class VehicleSpawner:
    """Draws vehicles and their routes.

    route_m: length of the ego vehicle's route, metres; others in proportion. mix: class of the vehicles -> share.
    """

    def __init__(self, city: CityPlan, assets: Assets, route_m: float, mix: Mapping[str, float]) -> None:
        self.city, self.assets, self.route_m, self._mix = city, assets, route_m, mix
        self._rng = city.stream("population")
        self._count = 0

    def spawn_ego(self, units: tuple[Unit, ...]) -> Vehicle:
        """The ego vehicle, on the approach to junction (0, 0)."""
        rng = self.city.stream("ego")
        direction = int(rng.integers(4))
        lane = int(rng.integers(self.city.street_at((0, 0), direction).lanes))
        edge = self.city.street_at((0, 0), direction + 1).half_width + STOP_LINE_M
        before, speed = edge + rng.uniform(18, 78), float(rng.uniform(8.0, 12.0))
        route = build_route(self.city, rng, (0, 0), direction, lane, before, self.route_m, speed, straight_on=0.4)
        return Vehicle(route, units, 8.0, speed * 0.6, 1.0)

    def spawn(self, around: Array, near_m: float, far_m: float, taken: Array, bicycle: bool) -> Vehicle | None:
        """Try to place a vehicle on a lane at a random point; None where it does not fit.

        around: world point (2,). near_m, far_m: least and greatest distance from it, metres.
        taken: (M, 2) world points of other vehicles. bicycle: whether to place a bicycle.
        """
        rng = self._rng
        x, y = self.city.unbend(around)
        axis = int(rng.integers(2))
        across, lengthwise = (y, x) if axis == 0 else (x, y)
        streets = self.city.streets_between(axis, across - far_m, across + far_m)
        if not streets:
            return None
        street = self.city.street(axis, streets[int(rng.integers(len(streets)))])
        at = lengthwise + rng.uniform(-far_m, far_m)
        direction = axis + 2 * int(rng.integers(2))
        following = self.city.below(1 - axis, at) + (direction < 2)
        node = (following, street.index) if axis == 0 else (street.index, following)
        before = float((self.city.node_center(node) - street.point(at)) @ DIRECTIONS[direction])
        lane = int(rng.integers(street.lanes))
        units = self._units(bicycle)
        length = units[-1].lag + float(units[-1].body.size_lwh[0])
        cross = self.city.street_at(node, direction + 1)
        if before < cross.half_width + STOP_LINE_M + 1:
            return None
        point = street.point(at) + right_of(direction) * street.lane_offset(lane, bicycle)
        front = self.city.bend(point)
        if not near_m <= np.hypot(*(front - around)) <= far_m:
            return None
        reach = np.linspace(-length - 6, 8, 10)[:, None] * DIRECTIONS[direction]  # the space needed before and behind
        gaps = self.city.bend(point + reach)[:, None] - taken
        if np.sqrt((gaps**2).sum(-1).min()) < (1.6 if bicycle else 2.2):
            return None
        speed = float(rng.uniform(3.5, 6.0) if bicycle else rng.uniform(7.5, 12.5))
        route_m, before = self.route_m * speed / 12 + length, before + length + 2
        route = build_route(self.city, rng, node, direction, lane, before, route_m, speed, bicycle=bicycle)
        return Vehicle(route, units, length + 2, speed * 0.7, float(rng.uniform(0.7, 1.25)), bicycle)

    def _units(self, bicycle: bool) -> tuple[Unit, ...]:
        rng, draw = self._rng, self.assets.draw
        class_name = "bicycle" if bicycle else str(rng.choice(list(self._mix), p=list(self._mix.values())))
        self._count += 1
        name = f"moving-{self._count}"
        if class_name == "train":
            heavy = rng.random() < 0.7
            first = draw("truck", rng, ("tractor",) if heavy else ("pickup", "delivery", "box"))
            second = draw("trailer", rng, SEMITRAILERS if heavy else ("utility",))
            tractor, towed = draw_body(first, rng, name), draw_body(second, rng, f"{name}-trailer")
            lag = float(tractor.size_lwh[0]) + (0.35 if not heavy else 0.25)
            return Unit(tractor, 0.0), Unit(towed, lag)
        return (Unit(draw_body(draw(class_name, rng, MOVING_LOOKS.get(class_name)), rng, name), 0.0),)
