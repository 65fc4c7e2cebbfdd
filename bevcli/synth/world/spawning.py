"""Spawning of vehicles: the ego vehicle, and traffic on the lanes around a point."""

from __future__ import annotations

import numpy as np

from bevcli.geometry.transforms import Array
from bevcli.synth.assets.catalog import Catalog, draw_body
from bevcli.synth.world.city import STOP_LINE_M, CityPlan
from bevcli.synth.world.route import (
    DIRECTIONS,
    LaneStart,
    bicycle_turns,
    build_route,
    draw_turns,
    lane_offset,
    node_center,
    right_of,
    street_of,
)
from bevcli.synth.world.traffic import Unit, Vehicle

TRAFFIC_MIX = {
    "car": 0.54, "truck": 0.12, "bus": 0.09, "train": 0.09, "motorcycle": 0.10, "construction_vehicle": 0.06,
}  # fmt: skip
RIDERS = {
    "motorcycle": ("sport_rider", "cruiser_rider", "scooter_rider"),
    "bicycle": ("city_rider", "racer_rider", "cargo_rider", "mountain_rider"),
}
DRIVING_MACHINES = ("loader", "backhoe", "crane", "mixer")
SEMITRAILERS = ("box", "curtain", "container", "tanker", "flatbed")


class VehicleSpawner:
    """Draws vehicles and their routes. route_m: length of the ego vehicle's route, metres; others in proportion."""

    def __init__(self, city: CityPlan, catalog: Catalog, route_m: float) -> None:
        self.city, self.catalog, self.route_m = city, catalog, route_m
        self._rng = city.stream("population")
        self._count = 0

    def spawn_ego(self, units: tuple[Unit, ...]) -> Vehicle:
        """The ego vehicle, on the approach to junction (0, 0)."""
        rng = self.city.stream("ego")
        direction = int(rng.integers(4))
        street = street_of(self.city, (0, 0), direction)
        cross = street_of(self.city, (0, 0), direction + 1)
        start = LaneStart(
            (0, 0), direction, int(rng.integers(street.lanes)), cross.half_width + STOP_LINE_M + rng.uniform(18, 78)
        )
        speed = float(rng.uniform(8.0, 12.0))
        route = build_route(self.city, start, draw_turns(self.city, start, rng, 0.4), self.route_m, speed)
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
        street = streets[int(rng.integers(len(streets)))]
        at = lengthwise + rng.uniform(-far_m, far_m)
        direction = axis + 2 * int(rng.integers(2))
        node = self._next_node(axis, street.index, at, direction)
        before = float((node_center(self.city, node) - _on_axis(axis, at, street.position)) @ DIRECTIONS[direction])
        lane = int(rng.integers(street.lanes))
        units = self._units(bicycle)
        length = units[-1].lag + float(units[-1].body.size_lwh[0])
        cross = street_of(self.city, node, direction + 1)
        if before < cross.half_width + STOP_LINE_M + 1:
            return None
        offset = right_of(direction) * lane_offset(street, lane, bicycle)
        front = self.city.bend(_on_axis(axis, at, street.position) + offset)
        if not near_m <= np.hypot(*(front - around)) <= far_m:
            return None
        reach = np.linspace(-length - 6, 8, 10)[:, None] * DIRECTIONS[direction]  # the space needed before and behind
        needed = self.city.bend(_on_axis(axis, at, street.position) + offset + reach)
        if _nearest(needed, taken) < (1.6 if bicycle else 2.2):
            return None
        start = LaneStart(node, direction, lane, before + length + 2)
        turns = bicycle_turns(rng) if bicycle else draw_turns(self.city, start, rng)
        speed = float(rng.uniform(3.5, 6.0) if bicycle else rng.uniform(7.5, 12.5))
        route = build_route(self.city, start, turns, self.route_m * speed / 12 + length, speed, bicycle)
        return Vehicle(route, units, length + 2, speed * 0.7, float(rng.uniform(0.7, 1.25)), bicycle)

    def _next_node(self, axis: int, index: int, at: float, direction: int) -> tuple[int, int]:
        nearest = self.city.nearest(1 - axis, at)
        position = self.city.street(1 - axis, nearest).position
        ahead = direction < 2
        if ahead and position < at:
            nearest += 1
        if not ahead and position > at:
            nearest -= 1
        return (nearest, index) if axis == 0 else (index, nearest)

    def _units(self, bicycle: bool) -> tuple[Unit, ...]:
        rng, draw = self._rng, self.catalog.draw
        class_name = "bicycle" if bicycle else str(rng.choice(list(TRAFFIC_MIX), p=list(TRAFFIC_MIX.values())))
        self._count += 1
        name = f"moving-{self._count}"
        if class_name == "train":
            heavy = rng.random() < 0.7
            first = draw("truck", rng, ("tractor",) if heavy else ("pickup", "delivery", "box"))
            second = draw("trailer", rng, SEMITRAILERS if heavy else ("utility",))
            tractor, towed = draw_body(first, rng, name), draw_body(second, rng, f"{name}-trailer")
            lag = float(tractor.size_lwh[0]) + (0.35 if not heavy else 0.25)
            return Unit(tractor, 0.0), Unit(towed, lag)
        names = RIDERS.get(class_name)
        if class_name == "construction_vehicle":
            names = DRIVING_MACHINES
        return (Unit(draw_body(draw(class_name, rng, names), rng, name), 0.0),)


def _on_axis(axis: int, at: float, across: float) -> Array:
    return np.array([at, across]) if axis == 0 else np.array([across, at])


def _nearest(points: Array, others: Array) -> float:
    """Smallest distance between points (P, 2) and (M, 2), metres; infinite where M is 0."""
    if not len(others):
        return float("inf")
    return float(np.sqrt(((points[:, None] - others[None]) ** 2).sum(-1).min()))
