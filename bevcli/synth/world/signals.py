"""Traffic signals: who may go at a junction at a time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

from bevcli.synth.world.city import CityPlan

Light = Literal["red", "yellow", "green"]
YELLOW_S, CLEARING_S = 1.5, 2.0
WALK_START_S = 4.5  # people start to cross only this soon after the traffic beside them got green


@dataclass(frozen=True)
class Program:
    """A cycle: green for axis 0, then for axis 1. Seconds; offset shifts the cycle."""

    greens: tuple[float, float]
    offset: float

    @property
    def cycle(self) -> float:
        """Seconds until everything repeats."""
        return sum(self.greens) + 2 * (YELLOW_S + CLEARING_S)

    def since_green(self, axis: int, time_s: float) -> float:
        """Seconds since an axis last got green."""
        return (time_s + self.offset - self.green_start(axis)) % self.cycle

    def green_start(self, axis: int) -> float:
        """When in the cycle an axis gets green, seconds."""
        return 0.0 if axis == 0 else self.greens[0] + YELLOW_S + CLEARING_S


class Signals:
    """The signals of a city. One street of a junction has the longer green.

    first: junction and axis by which the ego vehicle comes first.
    """

    def __init__(self, city: CityPlan, first: tuple[tuple[int, int], int]) -> None:
        self._city, self._first = city, first
        self.program = lru_cache(maxsize=None)(self._program)

    def _program(self, node: tuple[int, int]) -> Program:
        rng = self._city.stream("signals", *node)
        greens = (15.0, 10.0) if rng.random() < 0.5 else (10.0, 15.0)
        program = Program(greens, float(rng.uniform(0, 40)))
        if node == self._first[0]:  # something happens in every drive: this one is green soon
            return Program(greens, program.green_start(self._first[1]) + float(rng.uniform(-3, 11)))
        return program

    def light(self, node: tuple[int, int], axis: int, time_s: float) -> Light:
        """What vehicles on a street of this axis see."""
        program = self.program(node)
        since = program.since_green(axis, time_s)
        if since < program.greens[axis]:
            return "green"
        return "yellow" if since < program.greens[axis] + YELLOW_S else "red"

    def walk(self, node: tuple[int, int], axis: int, time_s: float) -> bool:
        """Whether people may start to cross a street of this axis: while the other axis has just got green."""
        return self.program(node).since_green(1 - axis, time_s) < WALK_START_S
