"""People who walk: along the pavements, and over the streets at junctions."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from bevcli.geometry.transforms import Array
from bevcli.workshop.synth.assets.catalog import Assets, Body, draw_body
from bevcli.workshop.synth.assets.people import PERSON_NAMES
from bevcli.workshop.synth.world.city import KERB_M, CityPlan, along, rounded_rectangle
from bevcli.workshop.synth.world.route import DIRECTIONS, distances_along, node_center, points_at, street_of
from bevcli.workshop.synth.world.traffic import MOVING_M_S, ActorState, Signals

STRIDE_M = 0.72  # distance after which the pose changes
CROSSING_LINE_M = 3.2  # from the edge of the junction to the line on which people cross
ALONG_PAVEMENT_M = 26.0  # length of a crosser's path on the pavement, before and after the road
STROLLERS_PER_BLOCK = 4.5  # mean number
SECONDS_BETWEEN_CROSSERS = 8.0  # mean time at a junction


@dataclass(frozen=True)
class Walker:
    """A person on a path.

    Attributes:
        city: the plan that the path belongs to.
        body: size and looks.
        path: (P, 2) plan points, metres.
        times: (K,) seconds; between them the person moves evenly.
        places: (K,) position along the path at these times, metres.
        road: start and end of the part of the path that is on a road, metres; negative for none.
    """

    city: CityPlan
    body: Body
    path: Array
    times: Array
    places: Array
    road: tuple[float, float]

    @cached_property
    def positions(self) -> Array:
        """(P,) position of each point along the path, metres."""
        return distances_along(self.path)

    def plan_at(self, time_s: ArrayLike) -> Array:
        """Plan points (..., 2) at times (...,) in seconds."""
        places = np.interp(np.asarray(time_s, dtype=np.float64), self.times, self.places)
        return points_at(places, self.path, self.positions)

    def on_road(self, time_s: float) -> bool:
        """True while the person walks and is on the road, so that vehicles must stop."""
        walks = self.times[0] < time_s < self.times[-1]
        return bool(walks and self.road[0] - 0.3 < np.interp(time_s, self.times, self.places) < self.road[1] + 0.3)

    def state(self, time_s: float) -> ActorState | None:
        """The state, or None before the walk begins and after it ends."""
        if not self.times[0] <= time_s <= self.times[-1]:
            return None
        place = float(np.interp(time_s, self.times, self.places))
        plan = self.plan_at([time_s - 0.02, time_s, time_s + 0.02])
        before, here, after = self.city.bend(plan)
        velocity = (after - before) / 0.04
        moving = float(np.hypot(*velocity)) > MOVING_M_S
        if moving:
            yaw = float(np.arctan2(velocity[1], velocity[0]))
        else:  # a waiting person faces along the path
            segment = int(np.searchsorted(self.positions, place, side="right"))
            way = self.path[segment] - self.path[segment - 1]
            yaw = self.city.heading(plan[1], way / max(float(np.hypot(*way)), 1e-9))
        inside = min(place - self.road[0], self.road[1] - place)  # metres into the road, negative on pavements
        position = np.array([here[0], here[1], KERB_M * float(np.clip(0.5 - inside / 0.3, 0, 1))])
        attribute = "pedestrian.moving" if moving else "pedestrian.standing"
        return ActorState(self.body, position, yaw, attribute, velocity, int(place / STRIDE_M) % 2)


def strollers(city: CityPlan, assets: Assets, span_s: tuple[float, float], column: int, row: int) -> list[Walker]:
    """People who walk around a block on its pavement. span_s: start and end of the simulation, seconds."""
    rng = city.stream("strollers", column, row)
    land = city.block(column, row)
    walkers = []
    for k in range(int(rng.poisson(STROLLERS_PER_BLOCK))):
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
        walkers.append(Walker(city, body, path, np.array(span_s), np.array([0.0, walked]), (-1.0, -1.0)))
    return walkers


def crossers(
    city: CityPlan, assets: Assets, signals: Signals, span_s: tuple[float, float], node: tuple[int, int]
) -> list[Walker]:
    """People who cross a street at a junction, over the whole simulation.

    node: column and row of the junction. span_s: start and end of the simulation, seconds.
    """
    rng = city.stream("crossers", *node)
    walkers: list[Walker] = []
    begin = span_s[0] - 30
    while begin < span_s[1]:
        name = f"crosser-{node[0]}-{node[1]}-{len(walkers)}"
        walkers.append(_crosser(city, assets, signals, node, begin, rng, name, len(walkers)))
        begin += rng.exponential(SECONDS_BETWEEN_CROSSERS)
    return walkers


def _crosser(
    city: CityPlan, assets: Assets, signals: Signals, node: tuple[int, int], begin: float,
    rng: np.random.Generator, name: str, index: int,
) -> Walker:  # fmt: skip
    """One person who walks to the kerb, waits for the signal, crosses the road and walks on.

    begin: start of the walk, seconds. index: number of the crosser at this junction; neighbours keep apart.
    """
    arm = int(rng.integers(4))
    street, cross = street_of(city, node, arm), street_of(city, node, arm + 1)
    side = 1 if rng.random() < 0.5 else -1  # each direction has its side of the crossing
    sideways = DIRECTIONS[(arm + 1) % 4] * side
    spot = node_center(city, node) + DIRECTIONS[arm] * (
        cross.half_width + CROSSING_LINE_M + side * (0.25 + 0.72 * (index % 3))
    )
    reach = street.half_width + ALONG_PAVEMENT_M
    path = along(spot - sideways * reach, spot + sideways * reach)
    speed = max(rng.uniform(1.0, 1.7), street.half_width / 6.5)  # crosses within 13 s
    kerb, far = ALONG_PAVEMENT_M - 0.5 - 0.85 * (index // 3 % 3), ALONG_PAVEMENT_M + 2 * street.half_width
    arrival = begin + kerb / speed
    start = arrival
    while not signals.walk(node, arm % 2, start):
        start += 0.25
    start += rng.uniform(0, 1.0) if start > arrival else 0.0
    end = start + (2 * reach - kerb) / speed
    body = _person(assets, rng, name)
    times, places = np.array([begin, arrival, start, end]), np.array([0.0, kerb, kerb, 2 * reach])
    return Walker(city, body, path, times, places, (ALONG_PAVEMENT_M, far))


def _person(assets: Assets, rng: np.random.Generator, name: str) -> Body:
    names = [n for n in PERSON_NAMES if n != "worker"]
    return draw_body(assets.draw("pedestrian", rng, names), rng, name, 0.03, rng.uniform(0.94, 1.05))
