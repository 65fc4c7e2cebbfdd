"""The simulation of a drive: traffic and pedestrians over its whole time, and the ego vehicle's motion."""

from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d

from bevcli.geometry.ego_motion import GRAVITY
from bevcli.geometry.transforms import Array
from bevcli.workshop.synth.catalog import Assets, draw_body
from bevcli.workshop.synth.city import DIRECTIONS, STOP_LINE_M, CityPlan, Route, build_route, right_of
from bevcli.workshop.synth.people import RIDDEN
from bevcli.workshop.synth.roadside import Roadside, StandingActor, Walker, crossers, strollers
from bevcli.workshop.synth.traffic import STEP_S, DrivingActor, Signals, Unit, Vehicle, interpolated_track, step

Actor = DrivingActor | StandingActor | Walker  # an annotated object over the time of a drive
TRAFFIC_MIX = {
    "car": 0.54, "truck": 0.12, "bus": 0.09, "train": 0.09, "motorcycle": 0.10, "construction_vehicle": 0.06,
}  # fmt: skip
MOVING_LOOKS = {**RIDDEN, "construction_vehicle": ("loader", "backhoe", "crane", "mixer")}
SEMITRAILERS = ("box", "curtain", "container", "tanker", "flatbed")


class VehicleSpawner:
    """Draws vehicles and their routes. route_m: length of the ego vehicle's route, metres; others in proportion."""

    def __init__(self, city: CityPlan, assets: Assets, route_m: float) -> None:
        self.city, self.assets, self.route_m = city, assets, route_m
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
        return (Unit(draw_body(draw(class_name, rng, MOVING_LOOKS.get(class_name)), rng, name), 0.0),)


WARM_UP_S = 6.0  # simulated time before the first frame, in which queues form
AFTER_S = 0.6  # simulated time after the last frame
VEHICLES, BICYCLES = 22, 6  # numbers around the ego vehicle, which counts as a vehicle
REACH_M = 75.0  # traffic is simulated within this distance of the ego vehicle
EGO_REAR_AXLE_M = 3.75  # from the front of the ego vehicle to its rear axle, the origin of the ego frame
EGO_SMOOTHING_S = 0.35  # standard deviation of the smoothing of the ego vehicle's speed


@dataclass(frozen=True)
class EgoTrack:
    """The motion of the ego vehicle's rear axle."""

    route: Route  # its route
    track: Array  # (3, T) times (seconds), route positions (metres), speeds (m/s)

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


class Simulation:
    """All actors of a drive of `duration_s` seconds. The same city gives the same simulation."""

    def __init__(self, city: CityPlan, assets: Assets, duration_s: float) -> None:
        self.city, self.assets = city, assets
        self.roadside = Roadside(city, assets)
        self.span_s = (-WARM_UP_S, duration_s + AFTER_S)
        self.spawner = VehicleSpawner(city, assets, 14.0 * (self.span_s[1] - self.span_s[0]) + 60)
        self.ego_body = draw_body(assets.by_class["car"][2], city.stream("ego-body"), "ego", 0.0)
        self._ego = self.spawner.spawn_ego((Unit(self.ego_body, 0.0),))
        first = self._ego.route.passes[0]
        self.signals = Signals(city, (first.node, first.direction % 2))
        self._crossers = lru_cache(maxsize=None)(partial(crossers, city, assets, self.signals, self.span_s))
        self._strollers = lru_cache(maxsize=None)(partial(strollers, city, assets, self.span_s))
        self._driving: list[DrivingActor] = []
        self._run()
        self.ego = _smoothed(self._ego)

    def actors_near(self, point: ArrayLike, reach_m: float) -> list[Actor]:
        """Actors that may be within `reach_m` metres of a world point (2,), and some that are not, in a fixed order."""
        near = self.city.around(point, reach_m)
        actors: list[Actor] = [*self._driving]
        for block in near.blocks:
            actors += [*self.roadside.block(*block), *self._strollers(*block)]
        for stretch in near.stretches:
            actors += self.roadside.stretch(*stretch)
        for node in near.blocks:
            actors += self._crossers(node)
        return actors

    def _run(self) -> None:
        vehicles, start = [self._ego], self.span_s[0] - STEP_S
        gone: list[Vehicle] = []
        steps = int(np.ceil((self.span_s[1] - self.span_s[0]) / STEP_S)) + 2
        self._ego.track.append((start, self._ego.front, self._ego.speed))
        self._populate(vehicles, 0.0, start)
        for k in range(steps):
            time_s = start + k * STEP_S
            step(vehicles, self._people_on_roads(vehicles, time_s), self.signals, time_s)
            if k % 10 == 9:
                gone += self._renew(vehicles, time_s + STEP_S)
        seen = [vehicle for vehicle in [*gone, *vehicles[1:]] if len(vehicle.track) > 1]
        self._driving = [DrivingActor(v, unit, np.array(v.track).T) for v in seen for unit in v.units]

    def _populate(self, vehicles: list[Vehicle], near_m: float, time_s: float) -> None:
        """Spawn vehicles around the ego vehicle, at least `near_m` metres away, until there are enough."""
        around = self._ego.route.at(self._ego.front + 25.0)
        taken = [vehicle.body_points() for vehicle in vehicles]
        for attempt in range(6 * (VEHICLES + BICYCLES)):
            bicycles = sum(v.bicycle for v in vehicles)
            wants_bicycle = bicycles < BICYCLES and attempt % 4 == 0
            if not wants_bicycle and len(vehicles) - bicycles >= VEHICLES:
                continue
            new = self.spawner.spawn(around, near_m, REACH_M, np.concatenate(taken), wants_bicycle)
            if new is not None:
                new.track.append((time_s, new.front, new.speed))
                vehicles.append(new)
                taken.append(new.body_points())

    def _renew(self, vehicles: list[Vehicle], time_s: float) -> list[Vehicle]:
        """Remove vehicles that are far away or at the end of their route, and spawn others. Returns those removed."""
        here = self._ego.route.at(self._ego.front)
        gone = [
            vehicle
            for vehicle in vehicles[1:]
            if vehicle.front > vehicle.route.positions[-1] - 15
            or np.hypot(*(vehicle.route.at(vehicle.front) - here)) > REACH_M + 30
        ]
        for vehicle in gone:
            vehicles.remove(vehicle)
        self._populate(vehicles, 58.0, time_s)
        return gone

    def _people_on_roads(self, vehicles: list[Vehicle], time_s: float) -> Array:
        """(H, 2) world points of people on the road at the junctions that vehicles approach."""
        nodes = sorted({p.node for v in vehicles if (p := v.next_pass()) is not None})
        points = [w.plan_at(time_s) for node in nodes for w in self._crossers(node) if w.on_road(time_s)]
        return self.city.bend(np.array(points).reshape(-1, 2))


def _smoothed(ego: Vehicle) -> EgoTrack:
    """The track of the ego vehicle with its speed smoothed, which limits its acceleration."""
    times, fronts, speeds = np.array(ego.track).T
    soft = gaussian_filter1d(speeds, EGO_SMOOTHING_S / STEP_S, mode="nearest")
    moved = np.concatenate([[0], np.cumsum((soft[1:] + soft[:-1]) / 2 * STEP_S)])
    return EgoTrack(ego.route, np.stack([times, fronts[0] - EGO_REAR_AXLE_M + moved, soft]))
