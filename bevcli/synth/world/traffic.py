"""The traffic simulation: vehicles follow routes, keep their distance, obey signals and give way."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.transforms import Array
from bevcli.jit import njit
from bevcli.synth.assets.catalog import Body
from bevcli.synth.world.route import JunctionPass, Route
from bevcli.synth.world.signals import Light, Signals

STEP_S = 0.1  # time step of the simulation
LOOK_AHEAD_M, LOOK_STEPS = 42.0, 54  # range of the search for obstacles, and its number of samples
CORRIDOR_M = 1.55  # obstacles nearer than this to the centre of a vehicle's lane block it
COMFORT = 2.0  # m/s², comfortable deceleration
HARDEST = -3.4  # m/s², strongest deceleration


@dataclass(frozen=True)
class Unit:
    """One part of a vehicle: the vehicle itself, its tractor or its trailer.

    Attributes:
        body: size and looks.
        lag: distance from the vehicle's front to the front of this unit, metres.
    """

    body: Body
    lag: float


@dataclass(eq=False)
class Vehicle:
    """A vehicle on its route.

    Attributes:
        route: the route.
        units: the vehicle, or tractor and trailer, from front to rear.
        front: route position of the vehicle's front, metres.
        speed: m/s.
        liveliness: factor on the acceleration, about 1.
        bicycle: whether it is a bicycle.
        track: (time, front, speed) of every step since it appeared; seconds, metres, m/s.
    """

    route: Route
    units: tuple[Unit, ...]
    front: float
    speed: float
    liveliness: float
    bicycle: bool = False
    track: list[tuple[float, float, float]] = field(default_factory=list)

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
    bodies = [vehicle.body_points() for vehicle in vehicles]
    owners = np.repeat(np.arange(len(bodies)), [len(b) for b in bodies])
    obstacles = np.concatenate([*bodies, people.reshape(-1, 2)])
    owners = np.concatenate([owners, np.full(len(people), -1)])
    speeds = np.array([v.speed for v in vehicles] + [0.0])
    accelerations = [
        _acceleration(index, vehicle, vehicles, obstacles, owners, speeds, signals, time_s)
        for index, vehicle in enumerate(vehicles)
    ]
    for vehicle, acceleration in zip(vehicles, accelerations, strict=True):
        faster = max(vehicle.speed + acceleration * STEP_S, 0.0)
        vehicle.front += (vehicle.speed + faster) / 2 * STEP_S
        vehicle.speed = faster
        vehicle.track.append((time_s + STEP_S, vehicle.front, vehicle.speed))


def _acceleration(
    index: int, vehicle: Vehicle, vehicles: list[Vehicle], obstacles: Array, owners: NDArray, speeds: Array,
    signals: Signals, time_s: float,
) -> float:  # fmt: skip
    """Acceleration in m/s² by the Intelligent Driver Model (IDM): the smallest of free road, obstacle and signal."""
    route = vehicle.route
    limit = float(np.interp(vehicle.front, route.positions, route.speed_limits))
    speed, strongest = vehicle.speed, 1.6 * vehicle.liveliness
    free = strongest * (1 - (speed / max(limit, 0.3)) ** 4) if speed <= limit else max(-2.2, (limit - speed) * 2.0)
    corridor = 0.9 if vehicle.bicycle else CORRIDOR_M
    gap, other = _nearest_in_way(route.points, route.positions, vehicle.front, obstacles, owners, index, corridor)
    wanted = free
    if gap < np.inf:
        lead = float(speeds[other]) if other >= 0 else 0.0
        lead = lead if _same_way(vehicle, vehicles, other) else 0.0
        wanted = min(wanted, _follow(speed, limit, strongest, gap, lead))
    crossing = vehicle.next_pass()
    if crossing is not None and vehicle.front < crossing.stop + 0.5:
        room = crossing.stop - vehicle.front
        needed = speed**2 / (2 * max(room, 0.1))
        if needed < 3.0 and not _may_enter(vehicle, crossing, vehicles, signals, time_s):
            wanted = min(wanted, _follow(speed, limit, strongest, room + 1.4, 0.0))
    return float(np.clip(wanted, HARDEST, strongest))


def _follow(speed: float, limit: float, strongest: float, gap: float, lead_speed: float) -> float:
    """Acceleration (IDM) behind a vehicle at `lead_speed`, `gap` metres ahead: keep a distance of 2 m plus 1.2 s."""
    desired = 2.0 + max(0.0, speed * 1.2 + speed * (speed - lead_speed) / (2 * np.sqrt(strongest * COMFORT)))
    return strongest * (1 - (speed / max(limit, 0.3)) ** 4 - (desired / max(gap, 0.1)) ** 2)


def _same_way(vehicle: Vehicle, vehicles: list[Vehicle], other: int) -> bool:
    """Whether the other vehicle drives in about the same direction (within 60 degrees)."""
    if other < 0:
        return False
    mine = vehicle.route.yaw_at(vehicle.front)
    theirs = vehicles[other].route.yaw_at(vehicles[other].front)
    return bool(np.cos(mine - theirs) > 0.5)


def _may_enter(
    vehicle: Vehicle, crossing: JunctionPass, vehicles: list[Vehicle], signals: Signals, time_s: float
) -> bool:
    """Whether the light is green and nobody has priority. Left turns may also start on yellow."""
    light = signals.light(crossing.node, crossing.direction % 2, time_s)
    if light != "green" and (light == "red" or crossing.turn <= 0):
        return False
    return not any(
        _has_priority(other, theirs, vehicle, crossing, light)
        for other in vehicles
        if other is not vehicle and (theirs := other.next_pass()) is not None and theirs.node == crossing.node
    )


def _has_priority(other: Vehicle, theirs: JunctionPass, vehicle: Vehicle, crossing: JunctionPass, light: Light) -> bool:
    """Whether the other vehicle has priority: oncoming over left turns, bicycles over right turns not yet begun."""
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
    """(count, 2) evenly spaced points of a route from position start to end.

    points: (P, 2) of the route. positions: (P,) along it, metres.
    """
    found = np.empty((count, 2))
    for i in range(count):
        place = start + (end - start) * i / (count - 1)
        k = min(max(int(np.searchsorted(positions, place)) - 1, 0), len(positions) - 2)
        w = min(max((place - positions[k]) / (positions[k + 1] - positions[k]), 0.0), 1.0)
        found[i, 0] = points[k, 0] + w * (points[k + 1, 0] - points[k, 0])
        found[i, 1] = points[k, 1] + w * (points[k + 1, 1] - points[k, 1])
    return found


@njit(nogil=True)
def _nearest_in_way(
    points: Array, positions: Array, front: float, obstacles: Array, owners: NDArray, own: int, corridor: float
) -> tuple[float, int]:
    """Find the first obstacle ahead on a route.

    points: (P, 2) of the route. positions: (P,) along it, metres. front: start of the search, metres.
    obstacles: (O, 2). owners: (O,) index of the vehicle that an obstacle point belongs to, -1 for people.
    own: index whose points are ignored. corridor: half the width of the search, metres.
    Returns the distance in metres and the owner; infinity and -1 where the road is free.
    """
    squared = corridor * corridor
    way = points_between(points, positions, front + 0.3, front + LOOK_AHEAD_M, LOOK_STEPS)
    reach = (LOOK_AHEAD_M + 5.0) ** 2
    near = [k for k in range(obstacles.shape[0]) if owners[k] != own
            and (obstacles[k, 0] - way[0, 0]) ** 2 + (obstacles[k, 1] - way[0, 1]) ** 2 < reach]  # fmt: skip
    for i in range(LOOK_STEPS):
        for k in near:
            dx, dy = obstacles[k, 0] - way[i, 0], obstacles[k, 1] - way[i, 1]
            if dx * dx + dy * dy < squared:
                return max(i * (LOOK_AHEAD_M - 0.3) / (LOOK_STEPS - 1) - 0.4, 0.05), owners[k]
    return np.inf, -1
