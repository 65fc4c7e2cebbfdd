"""The simulation of a drive: traffic and pedestrians over its whole time, and the ego vehicle's motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d

from bevcli.geometry.ego_motion import GRAVITY
from bevcli.geometry.transforms import Array
from bevcli.synth.assets.catalog import Catalog, draw_body
from bevcli.synth.world.actors import Actor, DrivingActor, interpolated_track
from bevcli.synth.world.city import CityPlan
from bevcli.synth.world.pedestrians import Walker, crossers, strollers
from bevcli.synth.world.roadside import Roadside
from bevcli.synth.world.route import Route
from bevcli.synth.world.signals import Signals
from bevcli.synth.world.spawning import VehicleSpawner
from bevcli.synth.world.traffic import STEP_S, Unit, Vehicle, step

WARM_UP_S = 6.0  # simulated time before the first frame, in which queues form
AFTER_S = 0.6  # simulated time after the last frame
VEHICLES, BICYCLES = 22, 6  # numbers around the ego vehicle, which counts as a vehicle
REACH_M = 75.0  # traffic is simulated within this distance of the ego vehicle
EGO_REAR_AXLE_M = 3.75  # from the front of the ego vehicle to its rear axle, the origin of the ego frame
EGO_SMOOTHING_S = 0.35  # standard deviation of the smoothing of the ego vehicle's speed


@dataclass(frozen=True)
class EgoTrack:
    """The motion of the ego vehicle's rear axle.

    Attributes:
        route: its route.
        times: (T,) seconds.
        positions: (T,) route positions, metres.
        speeds: (T,) m/s.
    """

    route: Route
    times: Array
    positions: Array
    speeds: Array

    def pose(self, time_s: float) -> tuple[Array, float]:
        """World point (2,) of the rear axle in metres, and yaw in radians, at a time in seconds."""
        s = interpolated_track(self.times, self.positions, self.speeds, time_s)
        return self.route.at(s), float(self.route.yaw_at(s))

    def motion(self, time_s: float) -> tuple[Array, Array, Array]:
        """Acceleration with gravity (m/s²), angular rate (rad/s) and velocity (m/s), each (3,), ego frame."""
        h = 0.05
        s = [interpolated_track(self.times, self.positions, self.speeds, time_s + d) for d in (-h, 0.0, h)]
        speed = (s[2] - s[0]) / (2 * h)
        rate = float(self.route.yaw_at(s[2]) - self.route.yaw_at(s[0])) / (2 * h)
        forward = float(
            np.interp(time_s + h, self.times, self.speeds) - np.interp(time_s - h, self.times, self.speeds)
        ) / (2 * h)
        return (
            np.array([forward, speed * rate, GRAVITY]),
            np.array([0.0, 0.0, rate]),
            np.array([speed, 0.0, 0.0]),
        )


class Simulation:
    """All actors of a drive of `duration_s` seconds. The same city gives the same simulation."""

    def __init__(self, city: CityPlan, catalog: Catalog, duration_s: float) -> None:
        self.city, self.catalog = city, catalog
        self.roadside = Roadside(city, catalog)
        self.span_s = (-WARM_UP_S, duration_s + AFTER_S)
        self.spawner = VehicleSpawner(city, catalog, 14.0 * (self.span_s[1] - self.span_s[0]) + 60)
        body = draw_body(catalog.by_class["car"][2], city.stream("ego-body"), "ego", 0.0)
        self.ego_body = body
        self._ego = self.spawner.spawn_ego((Unit(body, 0.0),))
        first = self._ego.route.passes[0]
        self.signals = Signals(city, (first.node, first.direction % 2))
        self._crossers: dict[tuple[int, int], list[Walker]] = {}
        self._strollers: dict[tuple[int, int], list[Walker]] = {}
        self._driving: list[DrivingActor] = []
        self._run()
        self.ego = _smoothed(self._ego)

    def actors_near(self, point: ArrayLike, reach_m: float) -> list[Actor]:
        """Actors that may be within `reach_m` metres of a world point (2,), and some that are not, in a fixed order."""
        x, y = self.city.unbend(point)
        columns = self.city.streets_between(1, x - reach_m, x + reach_m)
        rows = self.city.streets_between(0, y - reach_m, y + reach_m)
        spans = (
            range(columns[0].index - 1, columns[-1].index + 1)
            if columns
            else range(_below(self.city, 1, x), _below(self.city, 1, x) + 1),
            range(rows[0].index - 1, rows[-1].index + 1)
            if rows
            else range(_below(self.city, 0, y), _below(self.city, 0, y) + 1),
        )
        found: list[Actor] = [*self._driving]
        for i in spans[0]:
            for j in spans[1]:
                found += self.roadside.block(i, j)
                found += self._strollers_of(i, j)
        for street, span in [*((c, spans[1]) for c in columns), *((r, spans[0]) for r in rows)]:
            for k in span:
                found += self.roadside.stretch(street.axis, street.index, k)
        for i in spans[0]:
            for j in spans[1]:
                found += self._crossers_of((i, j))
        return found

    def _run(self) -> None:
        vehicles = [self._ego]
        self._populate(vehicles, 0.0)
        steps = int(np.ceil((self.span_s[1] - self.span_s[0]) / STEP_S)) + 2
        gone: list[Vehicle] = []
        start = self.span_s[0] - STEP_S
        for vehicle in vehicles:
            vehicle.track.append((start, vehicle.front, vehicle.speed))
        for k in range(steps):
            time_s = start + k * STEP_S
            step(vehicles, self._people_on_roads(vehicles, time_s), self.signals, time_s)
            if k % 10 == 9:
                gone += self._renew(vehicles, time_s + STEP_S)
        self._driving = [d for v in [*gone, *vehicles[1:]] if len(v.track) > 1 for d in DrivingActor.of(v)]

    def _populate(self, vehicles: list[Vehicle], near_m: float) -> None:
        """Spawn vehicles around the ego vehicle, at least `near_m` metres away, until there are enough."""
        ego = self._ego
        taken = [vehicle.body_points() for vehicle in vehicles]
        for attempt in range(6 * (VEHICLES + BICYCLES)):
            bicycles = sum(v.bicycle for v in vehicles)
            if len(vehicles) >= VEHICLES + BICYCLES:
                return
            wants_bicycle = bicycles < BICYCLES and attempt % 4 == 0
            if not wants_bicycle and len(vehicles) - bicycles >= VEHICLES:
                continue
            around = ego.route.at(ego.front + 25.0)
            new = self.spawner.spawn(around, near_m, REACH_M, np.concatenate(taken), wants_bicycle)
            if new is not None:
                vehicles.append(new)
                taken.append(new.body_points())

    def _renew(self, vehicles: list[Vehicle], time_s: float) -> list[Vehicle]:
        """Remove vehicles that are far away or at the end of their route, and spawn others. Returns those removed."""
        here = self._ego.route.at(self._ego.front)
        gone = []
        for vehicle in vehicles[1:]:
            far = np.hypot(*(vehicle.route.at(vehicle.front) - here)) > REACH_M + 30
            if far or vehicle.front > vehicle.route.length - 15:
                gone.append(vehicle)
        for vehicle in gone:
            vehicles.remove(vehicle)
        count = len(vehicles)
        self._populate(vehicles, 58.0)
        for vehicle in vehicles[count:]:
            vehicle.track.append((time_s, vehicle.front, vehicle.speed))
        return gone

    def _people_on_roads(self, vehicles: list[Vehicle], time_s: float) -> Array:
        """(H, 2) world points of people on the road at the junctions that vehicles approach."""
        nodes = sorted({p.node for v in vehicles if (p := v.next_pass()) is not None})
        points = [
            w.plan_at(time_s)
            for node in nodes
            for w in self._crossers_of(node)
            if w.times[0] < time_s < w.times[-1] and w.on_road(time_s)
        ]
        return self.city.bend(np.array(points).reshape(-1, 2))

    def _crossers_of(self, node: tuple[int, int]) -> list[Walker]:
        if node not in self._crossers:
            self._crossers[node] = crossers(self.city, self.catalog, self.signals, node, self.span_s)
        return self._crossers[node]

    def _strollers_of(self, column: int, row: int) -> list[Walker]:
        key = (column, row)
        if key not in self._strollers:
            self._strollers[key] = strollers(self.city, self.catalog, column, row, self.span_s)
        return self._strollers[key]


def _below(city: CityPlan, axis: int, position: float) -> int:
    index = city.nearest(axis, position)
    return index if city.street(axis, index).position <= position else index - 1


def _smoothed(ego: Vehicle) -> EgoTrack:
    """The track of the ego vehicle with its speed smoothed, which limits its acceleration."""
    times, fronts, speeds = np.array(ego.track).T
    soft = gaussian_filter1d(speeds, EGO_SMOOTHING_S / STEP_S, mode="nearest")
    moved = np.concatenate([[0], np.cumsum((soft[1:] + soft[:-1]) / 2 * STEP_S)])
    return EgoTrack(ego.route, times, fronts[0] - EGO_REAR_AXLE_M + moved, soft)
