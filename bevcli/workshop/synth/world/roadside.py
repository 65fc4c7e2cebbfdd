"""Annotated objects that stand still: parked vehicles, road works, building sites, standing people."""

from collections.abc import Collection, Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from bevcli.geometry.transforms import Array
from bevcli.workshop.synth.assets.catalog import Assets, Body, draw_body
from bevcli.workshop.synth.assets.people import CYCLES, PERSON_NAMES
from bevcli.workshop.synth.world.city import KERB_M, STOP_LINE_M, CityPlan, Street, side_of
from bevcli.workshop.synth.world.traffic import ActorState

PARKED_MIX = {"car": 0.78, "truck": 0.09, "trailer": 0.05, "motorcycle": 0.05, "bus": 0.03}
FILLED = 0.55  # share of parking spaces that are taken
WORKS_SHARE = 0.27  # share of parking lanes (one side of a stretch) with road works
PARKED_LOOKS = {**CYCLES, "bus": ("mini", "shuttle")}
ATTRIBUTES = {
    "bicycle": "cycle.without_rider", "motorcycle": "cycle.without_rider", "pedestrian": "pedestrian.standing",
    "barrier": "", "traffic_cone": "",
}  # of classes other than vehicles, which are parked  # fmt: skip


class StandingActor(ActorState):
    """An actor that never moves."""

    def state(self, time_s: float) -> ActorState:
        """The same state at all times."""
        return self


class Roadside:
    """The standing actors of a city. They are made when they are first needed, and kept."""

    def __init__(self, city: CityPlan, assets: Assets) -> None:
        self.city, self.assets = city, assets
        self.stretch = lru_cache(maxsize=None)(self._stretch)
        self.block = lru_cache(maxsize=None)(self._block)

    def _stretch(self, axis: int, index: int, cross: int) -> list[StandingActor]:
        """Actors on the parking lanes of a stretch.

        axis, index: of the street. cross: index of the street that crosses it at the beginning of the stretch.
        """
        return [*self._kerbside(axis, index, cross, -1), *self._kerbside(axis, index, cross, 1)]

    def _block(self, column: int, row: int) -> list[StandingActor]:
        """Actors on the pavements of a block, and on its building site."""
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
        """Draw a look, of those with these names, and an individual of it."""
        return draw_body(self.assets.draw(class_name, rng, names), rng, instance, spread)

    def _kerbside(self, axis: int, index: int, cross: int, side: int) -> list[StandingActor]:
        """One side of a stretch. side: +1 or -1, the sign of the offset from the centre line."""
        street = self.city.street(axis, index)
        if not street.parking_m:
            return []
        rng = self.city.stream("kerbside", axis, index, cross, side)
        before, after = self.city.street(1 - axis, cross), self.city.street(1 - axis, cross + 1)
        low = before.position + before.half_width + STOP_LINE_M + 2.5
        high = after.position - after.half_width - STOP_LINE_M - 2.5
        name = f"{axis}.{index}.{cross}.{side}"
        made: list[StandingActor] = []
        closed = (high + 1, high + 1)
        if rng.random() < WORKS_SHARE:
            length = rng.uniform(15, 24)
            if length < high - low:  # there is no room for them in a short block
                begin = rng.uniform(low, high - length)
                closed = (begin, begin + length)
                made += self._works(street, side, closed, rng, name)
        at = low
        while at < high - 4:
            class_name = str(rng.choice(list(PARKED_MIX), p=list(PARKED_MIX.values())))
            body = self._body(class_name, rng, f"parked-{name}-{len(made)}", names=PARKED_LOOKS.get(class_name))
            length = float(body.size_lwh[0])
            if at + length > high:
                break
            free = at + length + 1 < closed[0] or at > closed[1] + 1
            if free and rng.random() < FILLED:
                offset = street.half_width - 0.18 - body.size_lwh[1] / 2
                made.append(self._stand(street, body, at + length / 2, side * offset))
            at = at + length + rng.uniform(0.6, 1.3) if not (at <= closed[1] and not free) else closed[1] + 1.2
        return made

    def _works(
        self, street: Street, side: int, closed: tuple[float, float], rng: np.random.Generator, name: str
    ) -> Iterator[StandingActor]:
        """Road works on a part of the parking lane: barriers along the traffic, cones, a machine and workers.

        closed: start and end along the street, plan coordinates, metres.
        """
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
        """Parked bicycles and motorcycles, and groups of standing people."""
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
        """A building site on a block: barriers around machines, trucks, trailers, cones and workers."""
        rng = self.city.stream("site", column, row)
        name, (low, high) = f"{column}.{row}", self.city.block(column, row).inside(0.4)
        made = list(self._fence(low, high, rng, name))
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

    def _fence(self, low: Array, high: Array, rng: np.random.Generator, name: str) -> Iterator[StandingActor]:
        """Barriers along the edges of a rectangle of the plan, with gaps."""
        barrier = self.assets.draw("barrier", rng)
        for side in range(4):
            start, way, _, length = side_of(low, high, side)
            for k, at in enumerate(np.arange(1.8, length - 1.5, 4.2)):
                if rng.random() >= 0.12:
                    body = draw_body(barrier, rng, f"fence-{name}.{side}.{k}", 0.02)
                    yaw = self.city.heading(start + way * at, way) + np.pi / 2
                    yield self._stand_on_land(body, start + way * at, yaw)
