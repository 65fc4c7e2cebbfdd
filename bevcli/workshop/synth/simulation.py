"""All actors of a drive: pedestrians, what stands at the roadside, driving vehicles; and the ego vehicle's motion."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial

import numpy as np
from numpy.typing import ArrayLike

from bevcli.geometry.transforms import Array
from bevcli.workshop.synth import traffic
from bevcli.workshop.synth.catalog import Assets, Body, draw_body
from bevcli.workshop.synth.city import DIRECTIONS, KERB_M, CityPlan, Line, Street, along, rounded_rectangle, side_of
from bevcli.workshop.synth.road_users import CYCLES, PERSON_NAMES

TRAFFIC = {
    "car": 0.54, "truck": 0.12, "bus": 0.09, "train": 0.09, "motorcycle": 0.10, "construction_vehicle": 0.06,
}  # fmt: skip
PARKED = {"car": 0.78, "truck": 0.09, "trailer": 0.05, "motorcycle": 0.05, "bus": 0.03}


@dataclass(frozen=True)
class Density:
    """Numbers of road users, and their mixture."""

    vehicles: int = 22  # around the ego vehicle, which counts as a vehicle
    bicycles: int = 6  # that drive around the ego vehicle
    traffic: Mapping[str, float] = field(default_factory=lambda: TRAFFIC)  # class of driving vehicles -> share
    parked: Mapping[str, float] = field(default_factory=lambda: PARKED)  # class -> share
    filled: float = 0.55  # share of parking spaces that are taken
    works: float = 0.27  # share of parking lanes (one side of a stretch) with road works
    strollers: float = 4.5  # mean number for each block
    crosser_s: float = 8.0  # mean time between people who cross at a junction, seconds


def draw_density(rng: np.random.Generator) -> Density:
    """A density from that of the default to a crowded street, with a larger share of cars."""
    return Density(
        int(rng.integers(20, 60)),
        int(rng.integers(3, 9)),
        _with_cars(TRAFFIC, float(rng.uniform(0.55, 0.85))),
        _with_cars(PARKED, float(rng.uniform(0.72, 0.93))),
        float(rng.uniform(0.5, 1.0)),
        float(rng.choice([0.27, 0.1])),
        float(rng.uniform(3, 9)),
        float(rng.uniform(4, 10)),
    )


def _with_cars(mix: Mapping[str, float], cars: float) -> dict[str, float]:
    """The mixture with another share of cars; the others keep their proportions."""
    return {name: cars if name == "car" else share * (1 - cars) / (1 - mix["car"]) for name, share in mix.items()}


STRIDE_M = 0.72  # distance after which the pose changes
CROSSING_LINE_M = 3.2  # from the edge of the junction to the line on which people cross
ALONG_PAVEMENT_M = 26.0  # length of a crosser's path on the pavement, before and after the road


@dataclass(frozen=True)
class Walker:
    """A person on a path."""

    city: CityPlan  # the plan that the path belongs to
    body: Body  # size and looks
    path: Line  # in plan coordinates
    times: Array  # (K,) seconds; between them the person moves evenly
    walked_m: Array  # (K,) position along the path at these times, metres
    road: tuple[float, float]  # start and end of the part of the path that is on a road, metres; negative for none

    def plan_at(self, time_s: ArrayLike) -> Array:
        """Plan points (..., 2) at times (...,) in seconds."""
        walked_m = np.interp(np.asarray(time_s, dtype=np.float64), self.times, self.walked_m)
        return self.path.at(walked_m)

    def on_road(self, time_s: float) -> bool:
        """True while the person walks and is on the road, so that vehicles must stop."""
        walks = self.times[0] < time_s < self.times[-1]
        return bool(walks and self.road[0] - 0.3 < np.interp(time_s, self.times, self.walked_m) < self.road[1] + 0.3)

    def state(self, time_s: float) -> traffic.ActorState | None:
        """The state, or None before the walk begins and after it ends."""
        if not self.times[0] <= time_s <= self.times[-1]:
            return None
        walked = float(np.interp(time_s, self.times, self.walked_m))
        plan = self.plan_at([time_s - 0.02, time_s, time_s + 0.02])
        before, here, after = self.city.bend(plan)
        velocity = (after - before) / 0.04
        moving = float(np.hypot(*velocity)) > traffic.MOVING_M_S
        if moving:
            yaw = float(np.arctan2(velocity[1], velocity[0]))
        else:  # a waiting person faces along the path
            segment = int(np.searchsorted(self.path.positions, walked, side="right"))
            way = self.path.points[segment] - self.path.points[segment - 1]
            yaw = self.city.heading(plan[1], way / max(float(np.hypot(*way)), 1e-9))
        inside = min(walked - self.road[0], self.road[1] - walked)  # metres into the road, negative on pavements
        position = np.array([here[0], here[1], KERB_M * float(np.clip(0.5 - inside / 0.3, 0, 1))])
        attribute = "pedestrian.moving" if moving else "pedestrian.standing"
        return traffic.ActorState(self.body, position, yaw, attribute, velocity, int(walked / STRIDE_M) % 2)


def strollers(
    city: CityPlan, assets: Assets, mean: float, span_s: tuple[float, float], column: int, row: int
) -> list[Walker]:
    """People who walk around a block on its pavement.

    mean: of their number. span_s: start and end of the simulation, seconds.
    """
    rng = city.stream("strollers", column, row)
    land = city.block(column, row)
    walkers = []
    for k in range(int(rng.poisson(mean))):
        inset = rng.uniform(1.3, min(land.sidewalks) - 2.1)
        low, high = (land.low[0] + inset, land.low[1] + inset), (land.high[0] - inset, land.high[1] - inset)
        ring = np.roll(rounded_rectangle(low, high, 3.5), int(rng.integers(100)), axis=0)
        if rng.random() < 0.5:
            ring = ring[::-1]
        speed = rng.uniform(0.8, 1.7)
        lap = float(np.linalg.norm(np.diff(ring, axis=0, append=ring[:1]), axis=1).sum())
        walked = (span_s[1] - span_s[0]) * speed
        path = np.concatenate([ring] * (int(np.ceil(walked / lap)) + 1) + [ring[:1]])
        body = _person(assets, rng, f"stroller-{column}-{row}-{k}")
        walkers.append(Walker(city, body, Line(path), np.array(span_s), np.array([0.0, walked]), (-1.0, -1.0)))
    return walkers


def crossers(
    city: CityPlan,
    assets: Assets,
    every_s: float,
    signals: traffic.Signals,
    span_s: tuple[float, float],
    node: tuple[int, int],
) -> list[Walker]:
    """People who walk to the kerb at a junction (column, row), wait for the signal, cross the road and walk on.

    every_s: mean time between two of them, seconds. span_s: start and end of the simulation, seconds.
    """
    rng = city.stream("crossers", *node)
    walkers: list[Walker] = []
    begin = span_s[0] - 30
    while begin < span_s[1]:
        index = len(walkers)
        arm = int(rng.integers(4))
        street, cross = city.street_at(node, arm), city.street_at(node, arm + 1)
        side = 1 if rng.random() < 0.5 else -1  # each direction has its side of the crossing
        sideways = DIRECTIONS[(arm + 1) % 4] * side
        ahead = cross.half_width + CROSSING_LINE_M + side * (0.25 + 0.72 * (index % 3))
        spot, reach = city.node_center(node) + DIRECTIONS[arm] * ahead, street.half_width + ALONG_PAVEMENT_M
        path = Line(along(spot - sideways * reach, spot + sideways * reach))
        speed = max(rng.uniform(1.0, 1.7), street.half_width / 6.5)  # crosses within 13 s
        kerb, far = ALONG_PAVEMENT_M - 0.5 - 0.85 * (index // 3 % 3), ALONG_PAVEMENT_M + 2 * street.half_width
        arrival = begin + kerb / speed
        start = arrival
        while not signals.walk(node, arm % 2, start):
            start += 0.25
        start += rng.uniform(0, 1.0) if start > arrival else 0.0
        end = start + (2 * reach - kerb) / speed
        body = _person(assets, rng, f"crosser-{node[0]}-{node[1]}-{index}")
        times, walked_m = np.array([begin, arrival, start, end]), np.array([0.0, kerb, kerb, 2 * reach])
        walkers.append(Walker(city, body, path, times, walked_m, (ALONG_PAVEMENT_M, far)))
        begin += rng.exponential(every_s)
    return walkers


def _person(assets: Assets, rng: np.random.Generator, name: str) -> Body:
    names = [n for n in PERSON_NAMES if n != "worker"]
    return draw_body(assets.draw("pedestrian", rng, names), rng, name, 0.03, rng.uniform(0.94, 1.05))


PARKED_LOOKS = {**CYCLES, "bus": ("mini", "shuttle")}
ATTRIBUTES = {
    "bicycle": "cycle.without_rider", "motorcycle": "cycle.without_rider", "pedestrian": "pedestrian.standing",
    "barrier": "", "traffic_cone": "",
}  # of classes other than vehicles, which are parked  # fmt: skip


class StandingActor(traffic.ActorState):
    """An actor that never moves."""

    def state(self, time_s: float) -> traffic.ActorState:
        """The same state at all times."""
        return self


class Roadside:
    """The standing actors of a city. They are made when they are first needed, and kept."""

    def __init__(self, city: CityPlan, assets: Assets, density: Density = Density()) -> None:
        self.city, self.assets, self._density = city, assets, density
        self.stretch = lru_cache(maxsize=None)(self._stretch)
        self.block = lru_cache(maxsize=None)(self._block)

    def _stretch(self, axis: int, index: int, cross: int) -> list[StandingActor]:
        """Actors on the parking lanes of a stretch of street. cross: index of the street that crosses it first."""
        return [*self._kerbside(axis, index, cross, -1), *self._kerbside(axis, index, cross, 1)]

    def _block(self, column: int, row: int) -> list[StandingActor]:
        site = self._site(column, row) if self.city.landuse(column, row) == "site" else []
        return [*self._on_pavement(column, row), *site]

    def _body(
        self,
        class_name: str,
        rng: np.random.Generator,
        instance: str,
        spread: float = 0.05,
        names: Collection[str] | None = None,
    ) -> Body:
        return draw_body(self.assets.draw(class_name, rng, names), rng, instance, spread)

    def _kerbside(self, axis: int, index: int, cross: int, side: int) -> list[StandingActor]:
        """One side of a stretch. side: +1 or -1, the sign of the offset from the centre line."""
        street = self.city.street(axis, index)
        if not street.parking_m:
            return []
        rng = self.city.stream("kerbside", axis, index, cross, side)
        low, high = self.city.between_stop_lines(axis, index, cross)
        low, high, parked = low + 2.5, high - 2.5, self._density.parked
        name = f"{axis}.{index}.{cross}.{side}"
        made: list[StandingActor] = []
        closed = (high + 1, high + 1)
        if rng.random() < self._density.works:
            length = rng.uniform(15, 24)
            if length < high - low:  # there is no room for them in a short block
                begin = rng.uniform(low, high - length)
                closed = (begin, begin + length)
                made += self._works(street, side, closed, rng, name)
        at = low
        while at < high - 4:
            class_name = str(rng.choice(list(parked), p=list(parked.values())))
            body = self._body(class_name, rng, f"parked-{name}-{len(made)}", names=PARKED_LOOKS.get(class_name))
            length = float(body.size_lwh[0])
            if at + length > high:
                break
            free = at + length + 1 < closed[0] or at > closed[1] + 1
            if free and rng.random() < self._density.filled:
                offset = street.half_width - 0.18 - body.size_lwh[1] / 2
                made.append(self._stand(street, body, at + length / 2, side * offset))
            at = at + length + rng.uniform(0.6, 1.3) if not (at <= closed[1] and not free) else closed[1] + 1.2
        return made

    def _works(
        self, street: Street, side: int, closed: tuple[float, float], rng: np.random.Generator, name: str
    ) -> Iterator[StandingActor]:
        """Barriers along the traffic, cones, a machine and workers. closed: start and end along the street, metres."""
        start, end = closed
        edge, middle = street.half_width - 3.05, street.half_width - 1.4
        barrier = self.assets.draw("barrier", rng)
        for k, at in enumerate(np.arange(start + 4.0, end - 3.9, rng.choice([2.65, 2.65, 4.0]))):
            body = draw_body(barrier, rng, f"barrier-{name}-{k}", 0.02)
            yield self._stand(street, body, float(at), side * edge, np.pi / 2)
        cone = self.assets.draw("traffic_cone", rng)
        across = np.linspace(street.half_width - 0.3, edge + 0.1, 4)
        along = [*(start + 0.75 * np.arange(4)), *(end - 0.75 * np.arange(4))]
        for k, (at, offset) in enumerate(zip(along, [*across, *across], strict=True)):
            body = draw_body(cone, rng, f"cone-{name}-{k}", 0.03)
            yield self._stand(street, body, at, side * offset)
        machines = [(v.name, v.size_lwh) for v in self.assets.by_class["construction_vehicle"]]
        small = [look for look, size in machines if size[0] < end - start - 8 and size[1] < 2.72]
        machine = self._body("construction_vehicle", rng, f"machine-{name}", names=small)
        space = (start + 4 + machine.size_lwh[0] / 2, end - 4 - machine.size_lwh[0] / 2)
        at = float(rng.uniform(*space)) if space[1] > space[0] else (start + end) / 2
        turned = np.pi if rng.random() < 0.3 else 0.0
        yield self._stand(street, machine, at, side * middle, turned)
        for k in range(int(rng.integers(1, 4))):
            body = self._body("pedestrian", rng, f"worker-{name}-{k}", 0.03, ["worker_standing"])
            at = start + 2.9 if k == 0 else end - 2.1 - 0.8 * k
            offset = side * (street.half_width - (0.6, 0.7, 1.5)[k])
            yield self._stand(street, body, at, offset, float(rng.uniform(0, 6.3)))

    def _stand(self, street: Street, body: Body, at: float, offset: float, turn: float = 0.0) -> StandingActor:
        """An actor on a street that faces in the direction of the traffic on its side, turned by `turn` radians.

        at: position along the street; offset: from its centre line; metres, plan coordinates.
        """
        plan, forward = street.point(at, offset), float(-np.sign(offset) if street.axis == 0 else np.sign(offset))
        direction = (forward, 0.0) if street.axis == 0 else (0.0, forward)
        return self._stand_on_land(body, plan, self.city.heading(plan, direction) + turn, 0.0)

    def _on_pavement(self, column: int, row: int) -> list[StandingActor]:
        rng = self.city.stream("pavement", column, row)
        land, made = self.city.block(column, row), []
        for side in range(4):
            start, way, inward, length = side_of(land.low, land.high, side)
            depth, name = land.sidewalks[side] - 1.0, f"{column}.{row}.{side}"
            for group in range(int(rng.poisson(0.7))):
                # Racks do not overlap: each has a quarter of the side for itself.
                at = 9 + (length - 22) * (group + rng.random()) / 4
                for k in range(int(rng.integers(1, 4)) if group < 4 else 0):
                    class_name = "bicycle" if rng.random() < 0.75 else "motorcycle"
                    body = self._body(class_name, rng, f"rack-{name}.{group}.{k}", 0.03, CYCLES[class_name])
                    point = start + way * (at + 0.85 * k) + inward * depth
                    made.append(self._stand_on_land(body, point, self.city.heading(point, inward)))
            for group in range(int(rng.poisson(0.5))):
                middle = start + way * rng.uniform(8, length - 8) + inward * depth
                if (self._distances(made, middle) < 2.6).any():
                    continue
                for k in range(int(rng.integers(1, 4))):
                    names = [f"{n}_standing" for n in PERSON_NAMES if n != "worker"]
                    body = self._body("pedestrian", rng, f"standing-{name}.{group}.{k}", 0.03, names)
                    angle = 2.1 * k + rng.uniform(-0.3, 0.3)
                    point = middle + 0.55 * np.array([np.cos(angle), np.sin(angle)])
                    made.append(self._stand_on_land(body, point, self.city.heading(point, middle - point)))
        return made

    def _distances(self, made: list[StandingActor], point: Array) -> Array:
        """(M,) distances of the actors from a plan point (2,), metres."""
        x, y = self.city.bend(point)
        return np.array([np.hypot(m.position[0] - x, m.position[1] - y) for m in made])

    def _stand_on_land(self, body: Body, point: ArrayLike, yaw: float, height: float = KERB_M) -> StandingActor:
        """An actor at a plan point (2,). height: of the ground, metres."""
        attribute = ATTRIBUTES.get(body.variant.class_name, "vehicle.parked")
        return StandingActor(body, np.array([*self.city.bend(point), height]), yaw, attribute)

    def _site(self, column: int, row: int) -> list[StandingActor]:
        rng = self.city.stream("site", column, row)
        name, (low, high) = f"{column}.{row}", self.city.block(column, row).inside(0.4)
        made: list[StandingActor] = []
        barrier = self.assets.draw("barrier", rng)
        for side in range(4):
            start, way, _, length = side_of(low, high, side)
            for k, at in enumerate(np.arange(1.8, length - 1.5, 4.2)):
                if rng.random() >= 0.12:
                    body = draw_body(barrier, rng, f"fence-{name}.{side}.{k}", 0.02)
                    yaw = self.city.heading(start + way * at, way) + np.pi / 2
                    made.append(self._stand_on_land(body, start + way * at, yaw))
        machines = [("construction_vehicle", None)] * int(rng.integers(4, 7))
        trucks = [("truck", ("dumper", "flatbed"))] * 2
        trailers = [("trailer", ("flatbed", "container", "utility"))]
        for k, (class_name, names) in enumerate([*machines, *trucks, *trailers]):
            body = self._body(class_name, rng, f"site-{name}.{k}", names=names)
            lengths = np.array([m.body.size_lwh[0] for m in made]) + body.size_lwh[0]
            for _ in range(12):
                point = low + 8 + rng.random(2) * (high - low - 16)
                if (self._distances(made, point) > lengths / 2).all():
                    made.append(self._stand_on_land(body, point, float(rng.uniform(0, 6.3))))
                    break
        for k in range(8):
            point = low + 1.4 + rng.random(2) * (high - low - 2.8)
            if rng.random() < 0.5:
                body = self._body("pedestrian", rng, f"siteworker-{name}.{k}", 0.03, ["worker_standing"])
                made.append(self._stand_on_land(body, point, float(rng.uniform(0, 6.3))))
            else:
                body = self._body("traffic_cone", rng, f"sitecone-{name}.{k}", 0.03)
                made.append(self._stand_on_land(body, point, 0.0))
        return made


Actor = traffic.DrivingActor | StandingActor | Walker  # an annotated object over the time of a drive

WARM_UP_S = 6.0  # simulated time before the first frame, in which queues form
AFTER_S = 0.6  # simulated time after the last frame
REACH_M = 75.0  # traffic is simulated within this distance of the ego vehicle


class Simulation:
    """All actors of a drive of `duration_s` seconds. The same city gives the same simulation."""

    def __init__(self, city: CityPlan, assets: Assets, duration_s: float, density: Density = Density()) -> None:
        self.city, self.assets, self._density = city, assets, density
        self.roadside = Roadside(city, assets, density)
        self.span_s = (-WARM_UP_S, duration_s + AFTER_S)
        route_m = 14.0 * (self.span_s[1] - self.span_s[0]) + 60
        self.spawner = traffic.VehicleSpawner(city, assets, route_m, density.traffic)
        self.ego_body = draw_body(assets.by_class["car"][2], city.stream("ego-body"), "ego", 0.0)
        self._ego = self.spawner.spawn_ego((traffic.Unit(self.ego_body, 0.0),))
        first = self._ego.route.passes[0]
        self.signals = traffic.Signals(city, (first.node, first.direction % 2))
        crossing = partial(crossers, city, assets, density.crosser_s, self.signals, self.span_s)
        self._crossers = lru_cache(maxsize=None)(crossing)
        self._strollers = lru_cache(maxsize=None)(partial(strollers, city, assets, density.strollers, self.span_s))
        self._driving: list[traffic.DrivingActor] = []
        self._run()
        self.ego = traffic.EgoTrack.smoothed(self._ego)

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
        vehicles, start = [self._ego], self.span_s[0] - traffic.STEP_S
        gone: list[traffic.Vehicle] = []
        steps = int(np.ceil((self.span_s[1] - self.span_s[0]) / traffic.STEP_S)) + 2
        self._ego.track.append((start, self._ego.front, self._ego.speed))
        self._populate(vehicles, 0.0, start)
        for k in range(steps):
            time_s = start + k * traffic.STEP_S
            nodes = sorted({p.node for v in vehicles if (p := v.next_pass()) is not None})  # that vehicles approach
            people = [w.plan_at(time_s) for node in nodes for w in self._crossers(node) if w.on_road(time_s)]
            traffic.step(vehicles, self.city.bend(np.array(people).reshape(-1, 2)), self.signals, time_s)
            if k % 10 == 9:
                gone += self._renew(vehicles, time_s + traffic.STEP_S)
        seen = [vehicle for vehicle in [*gone, *vehicles[1:]] if len(vehicle.track) > 1]
        self._driving = [traffic.DrivingActor(v, unit, np.array(v.track).T) for v in seen for unit in v.units]

    def _populate(self, vehicles: list[traffic.Vehicle], near_m: float, time_s: float) -> None:
        """Spawn vehicles around the ego vehicle, at least `near_m` metres away, until there are enough."""
        around = self._ego.route.at(self._ego.front + 25.0)
        taken = [vehicle.body_points() for vehicle in vehicles]
        most, most_bicycles = self._density.vehicles, self._density.bicycles
        for attempt in range(6 * (most + most_bicycles)):
            bicycles = sum(v.bicycle for v in vehicles)
            wants_bicycle = bicycles < most_bicycles and attempt % 4 == 0
            if not wants_bicycle and len(vehicles) - bicycles >= most:
                continue
            new = self.spawner.spawn(around, near_m, REACH_M, np.concatenate(taken), wants_bicycle)
            if new is not None:
                new.track.append((time_s, new.front, new.speed))
                vehicles.append(new)
                taken.append(new.body_points())

    def _renew(self, vehicles: list[traffic.Vehicle], time_s: float) -> list[traffic.Vehicle]:
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
