"""Traffic signals: the lights of a junction over time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

from bevcli.synth.world.city import CityPlan

Light = Literal["red", "yellow", "green"]
YELLOW_S, CLEARING_S = 1.5, 2.0  # durations of yellow, and of red in all directions
WALK_START_S = 4.5  # people may start to cross until this time after parallel traffic got green


@dataclass(frozen=True)
class SignalCycle:
    """The cycle of one junction: axis 0 has green first, then axis 1.

    Attributes:
        greens: duration of green for axis 0 and for axis 1, seconds.
        offset: position in the cycle at time 0, seconds.
    """

    greens: tuple[float, float]
    offset: float

    @property
    def length(self) -> float:
        """Length of the cycle, seconds."""
        return sum(self.greens) + 2 * (YELLOW_S + CLEARING_S)

    def since_green(self, axis: int, time_s: float) -> float:
        """Seconds since an axis last got green, at a time in seconds."""
        return (time_s + self.offset - self.green_start(axis)) % self.length

    def green_start(self, axis: int) -> float:
        """Position in the cycle at which an axis gets green, seconds."""
        return 0.0 if axis == 0 else self.greens[0] + YELLOW_S + CLEARING_S


class Signals:
    """The signals of a city.

    first: node and axis of the ego vehicle's approach to its first junction. Its light turns green early in the
    drive, so that the ego vehicle does not wait for the whole drive.
    """

    def __init__(self, city: CityPlan, first: tuple[tuple[int, int], int]) -> None:
        self._city, self._first = city, first
        self.cycle = lru_cache(maxsize=None)(self._cycle)

    def _cycle(self, node: tuple[int, int]) -> SignalCycle:
        rng = self._city.stream("signals", *node)
        greens = (15.0, 10.0) if rng.random() < 0.5 else (10.0, 15.0)
        cycle = SignalCycle(greens, float(rng.uniform(0, 40)))
        if node == self._first[0]:
            return SignalCycle(greens, cycle.green_start(self._first[1]) + float(rng.uniform(-3, 11)))
        return cycle

    def light(self, node: tuple[int, int], axis: int, time_s: float) -> Light:
        """The light for vehicles on a street of this axis."""
        cycle = self.cycle(node)
        since = cycle.since_green(axis, time_s)
        if since < cycle.greens[axis]:
            return "green"
        return "yellow" if since < cycle.greens[axis] + YELLOW_S else "red"

    def walk(self, node: tuple[int, int], axis: int, time_s: float) -> bool:
        """Whether people may start to cross a street of this axis: shortly after the other axis got green."""
        return self.cycle(node).since_green(1 - axis, time_s) < WALK_START_S
