"""Annotated objects that stand still: parked vehicles, road works, building sites, standing people."""

from __future__ import annotations

import numpy as np

from bevcli.geometry.transforms import Array
from bevcli.synth.assets.catalog import Body, Catalog, draw_body
from bevcli.synth.assets.people import PERSON_NAMES
from bevcli.synth.world.actors import StandingActor
from bevcli.synth.world.city import KERB_M, STOP_LINE_M, CityPlan, Street

PARKED_MIX = {"car": 0.78, "truck": 0.09, "trailer": 0.05, "motorcycle": 0.05, "bus": 0.03}
FILLED = 0.55  # share of parking spaces that are taken
WORKS_SHARE = 0.27  # share of parking lanes (one side of a stretch) with road works
WITHOUT_RIDER = {
    "motorcycle": ("sport", "cruiser", "scooter"),
    "bicycle": ("city", "racer", "cargo", "mountain"),
}


class Roadside:
    """The standing actors of a city. They are made when they are first needed, and kept."""

    def __init__(self, city: CityPlan, catalog: Catalog) -> None:
        self.city, self.catalog = city, catalog
        self._made: dict[tuple[str, int, int], list[StandingActor]] = {}

    def stretch(self, axis: int, index: int, cross: int) -> list[StandingActor]:
        """Actors on the parking lanes of a stretch.

        axis, index: of the street. cross: index of the street that crosses it at the beginning of the stretch.
        """
        key = (f"stretch{axis}", index, cross)
        if key not in self._made:
            self._made[key] = [*self._kerbside(axis, index, cross, -1), *self._kerbside(axis, index, cross, 1)]
        return self._made[key]

    def block(self, column: int, row: int) -> list[StandingActor]:
        """Actors on the pavements of a block, and on its building site."""
        key = ("block", column, row)
        if key not in self._made:
            self._made[key] = self._on_pavement(column, row)
            if self.city.landuse(column, row) == "site":
                self._made[key] += self._site(column, row)
        return self._made[key]

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
            names = WITHOUT_RIDER.get(class_name)
            if class_name == "bus":
                names = ("mini", "shuttle")
            body = draw_body(self.catalog.draw(class_name, rng, names), rng, f"parked-{name}-{len(made)}")
            length = float(body.size_lwh[0])
            if at + length > high:
                break
            free = at + length + 1 < closed[0] or at > closed[1] + 1
            if free and rng.random() < FILLED:
                offset = street.half_width - 0.18 - body.size_lwh[1] / 2
                made.append(self._stand(street, body, at + length / 2, side * offset, side, "vehicle.parked"))
            at = at + length + rng.uniform(0.6, 1.3) if not (at <= closed[1] and not free) else closed[1] + 1.2
        return made

    def _works(
        self, street: Street, side: int, closed: tuple[float, float], rng: np.random.Generator, name: str
    ) -> list[StandingActor]:
        """Road works on a part of the parking lane: barriers along the traffic, cones, a machine and workers.

        closed: start and end along the street, plan coordinates, metres.
        """
        draw, made = self.catalog.draw, []
        edge, middle = street.half_width - 3.05, street.half_width - 1.4
        barrier = draw("barrier", rng)
        for k, at in enumerate(np.arange(closed[0] + 4.0, closed[1] - 3.9, rng.choice([2.65, 2.65, 4.0]))):
            body = draw_body(barrier, rng, f"barrier-{name}-{k}", 0.02)
            made.append(self._stand(street, body, float(at), side * edge, side, "", np.pi / 2))
        cone = draw("traffic_cone", rng)
        across = np.linspace(street.half_width - 0.3, edge + 0.1, 4)
        taper = [(closed[0] + 0.75 * k, offset) for k, offset in enumerate(across)]
        taper += [(closed[1] - 0.75 * k, offset) for k, offset in enumerate(across)]
        for k, (at, offset) in enumerate(taper):
            made.append(
                self._stand(street, draw_body(cone, rng, f"cone-{name}-{k}", 0.03), at, side * offset, side, "")
            )
        small = [
            v.name
            for v in self.catalog.by_class["construction_vehicle"]
            if v.size_lwh[0] < closed[1] - closed[0] - 8 and v.size_lwh[1] < 2.72
        ]
        machine = draw_body(draw("construction_vehicle", rng, small), rng, f"machine-{name}")
        space = (closed[0] + 4 + machine.size_lwh[0] / 2, closed[1] - 4 - machine.size_lwh[0] / 2)
        at = float(rng.uniform(*space)) if space[1] > space[0] else (closed[0] + closed[1]) / 2
        turned = np.pi if rng.random() < 0.3 else 0.0
        made.append(self._stand(street, machine, at, side * middle, side, "vehicle.parked", turned))
        for k in range(int(rng.integers(1, 4))):
            body = draw_body(draw("pedestrian", rng, ["worker_standing"]), rng, f"worker-{name}-{k}", 0.03)
            where = closed[0] + 2.9 if k == 0 else closed[1] - 2.1 - 0.8 * k
            turn = float(rng.uniform(0, 6.3))
            made.append(
                self._stand(
                    street,
                    body,
                    where,
                    side * (street.half_width - (0.6, 0.7, 1.5)[k]),
                    side,
                    "pedestrian.standing",
                    turn,
                )
            )
        return made

    def _stand(
        self,
        street: Street,
        body: Body,
        at: float,
        offset: float,
        side: int,
        attribute: str,
        turn: float = 0.0,
    ) -> StandingActor:
        """An actor on a street that faces in the direction of the traffic on its side, turned by `turn` radians.

        at: position along the street; offset: from its centre line; metres, plan coordinates.
        """
        plan = (at, street.position + offset) if street.axis == 0 else (street.position + offset, at)
        forward = -side if street.axis == 0 else side
        direction = (float(forward), 0.0) if street.axis == 0 else (0.0, float(forward))
        x, y = self.city.bend(plan)
        class_name = body.variant.class_name
        attribute = "cycle.without_rider" if class_name in ("motorcycle", "bicycle") else attribute
        return StandingActor(body, np.array([x, y, 0.0]), self.city.heading(plan, direction) + turn, attribute)

    def _on_pavement(self, column: int, row: int) -> list[StandingActor]:
        """Parked bicycles and motorcycles, and groups of standing people."""
        rng = self.city.stream("pavement", column, row)
        land, made = self.city.block(column, row), []
        for side in range(4):
            start, end, inward = land.side(side)
            length = float(np.hypot(*(end - start)))
            way = (end - start) / length
            depth = land.sidewalks[side]
            for group in range(int(rng.poisson(0.7))):
                # Racks do not overlap: each has a quarter of the side for itself.
                at = 9 + (length - 22) * (group + rng.random()) / 4
                for k in range(int(rng.integers(1, 4)) if group < 4 else 0):
                    class_name = "bicycle" if rng.random() < 0.75 else "motorcycle"
                    variant = self.catalog.draw(class_name, rng, WITHOUT_RIDER[class_name])
                    body = draw_body(variant, rng, f"rack-{column}.{row}.{side}.{group}.{k}", 0.03)
                    point = start + way * (at + 0.85 * k) + inward * (depth - 1.0)
                    made.append(
                        self._stand_on_land(body, point, self.city.heading(point, inward), "cycle.without_rider")
                    )
            for group in range(int(rng.poisson(0.5))):
                middle = start + way * rng.uniform(8, length - 8) + inward * (depth - 1.0)
                x, y = self.city.bend(middle)
                if any(np.hypot(m.position[0] - x, m.position[1] - y) < 2.6 for m in made):
                    continue
                for k in range(int(rng.integers(1, 4))):
                    names = [f"{n}_standing" for n in PERSON_NAMES if n != "worker"]
                    variant = self.catalog.draw("pedestrian", rng, names)
                    body = draw_body(variant, rng, f"standing-{column}.{row}.{side}.{group}.{k}", 0.03)
                    angle = 2.1 * k + rng.uniform(-0.3, 0.3)
                    point = middle + 0.55 * np.array([np.cos(angle), np.sin(angle)])
                    facing = self.city.heading(point, middle - point)
                    made.append(self._stand_on_land(body, point, facing, "pedestrian.standing"))
        return made

    def _stand_on_land(self, body: Body, point: Array, yaw: float, attribute: str) -> StandingActor:
        x, y = self.city.bend(point)
        return StandingActor(body, np.array([x, y, KERB_M]), yaw, attribute)

    def _site(self, column: int, row: int) -> list[StandingActor]:
        """A building site on a block: barriers around machines, trucks, trailers, cones and workers."""
        rng = self.city.stream("site", column, row)
        land, made = self.city.block(column, row), []
        south, east, north, west = land.sidewalks
        low = np.array([land.low[0] + west + 0.4, land.low[1] + south + 0.4])
        high = np.array([land.high[0] - east - 0.4, land.high[1] - north - 0.4])
        barrier = self.catalog.draw("barrier", rng)
        corners = [low, np.array([high[0], low[1]]), high, np.array([low[0], high[1]])]
        for side in range(4):
            start, end = corners[side], corners[(side + 1) % 4]
            way = (end - start) / np.hypot(*(end - start))
            for k, at in enumerate(np.arange(1.8, float(np.hypot(*(end - start))) - 1.5, 4.2)):
                if rng.random() < 0.12:
                    continue
                point = start + way * at
                body = draw_body(barrier, rng, f"fence-{column}.{row}.{side}.{k}", 0.02)
                made.append(self._stand_on_land(body, point, self.city.heading(point, way) + np.pi / 2, ""))
        for k, (class_name, names, attribute) in enumerate(
            [
                *[("construction_vehicle", None, "vehicle.parked")] * int(rng.integers(4, 7)),
                *[("truck", ("dumper", "flatbed"), "vehicle.parked")] * 2,
                ("trailer", ("flatbed", "container", "utility"), "vehicle.parked"),
            ]
        ):
            body = draw_body(self.catalog.draw(class_name, rng, names), rng, f"site-{column}.{row}.{k}")
            for _ in range(12):
                point = low + 8 + rng.random(2) * (high - low - 16)
                x, y = self.city.bend(point)
                clear = all(
                    np.hypot(m.position[0] - x, m.position[1] - y) > (m.body.size_lwh[0] + body.size_lwh[0]) / 2
                    for m in made
                )
                if clear:
                    made.append(self._stand_on_land(body, point, float(rng.uniform(0, 6.3)), attribute))
                    break
        for k in range(8):
            point = low + 1.4 + rng.random(2) * (high - low - 2.8)
            if rng.random() < 0.5:
                body = draw_body(
                    self.catalog.draw("pedestrian", rng, ["worker_standing"]),
                    rng,
                    f"siteworker-{column}.{row}.{k}",
                    0.03,
                )
                made.append(self._stand_on_land(body, point, float(rng.uniform(0, 6.3)), "pedestrian.standing"))
            else:
                body = draw_body(self.catalog.draw("traffic_cone", rng), rng, f"sitecone-{column}.{row}.{k}", 0.03)
                made.append(self._stand_on_land(body, point, 0.0, ""))
        return made
