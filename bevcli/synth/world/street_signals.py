"""The traffic signals that stand at junctions, showing what they show at a time."""

from __future__ import annotations

from numpy.typing import ArrayLike

from bevcli.synth.render.triangles import Run, place
from bevcli.synth.world.city import KERB_M, CityPlan
from bevcli.synth.world.route import DIRECTIONS, node_center, right_of, street_of
from bevcli.synth.world.scenery import Furnishings
from bevcli.synth.world.signals import Signals

REACH_M = 110.0


def signal_runs(
    city: CityPlan, signals: Signals, furnishings: Furnishings, here: ArrayLike, time_s: float
) -> list[Run]:
    """Signals of all junctions around a world point (2,): one for each approach, behind the junction on its right."""
    x, y = city.unbend(here)
    runs = []
    for column in city.streets_between(1, x - REACH_M, x + REACH_M):
        for row in city.streets_between(0, y - REACH_M, y + REACH_M):
            node = (column.index, row.index)
            for direction in range(4):
                street, cross = street_of(city, node, direction), street_of(city, node, direction + 1)
                ahead = DIRECTIONS[direction] * (cross.half_width + 0.9)
                spot = node_center(city, node) + ahead + right_of(direction) * (street.half_width + 0.9)
                shape = furnishings.signals[signals.light(node, direction % 2, time_s)]
                yaw = city.heading(spot, -DIRECTIONS[direction])
                point = city.bend(spot)
                runs.append(place(shape, (float(point[0]), float(point[1]), KERB_M), yaw))
    return runs
