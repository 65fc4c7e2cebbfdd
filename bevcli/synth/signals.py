"""Traffic signals: who may go at a junction at a time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

from bevcli.synth.city import CityPlan

Light = Literal["red", "yellow", "green"]
YELLOW_S, CLEARING_S, WALK_S, START_S = 1.5, 2.0, 13.0, 4.0


@dataclass(frozen=True)
class Program:
    """A cycle: green for axis 0, green for axis 1, then all pedestrians walk. Seconds; offset shifts the cycle."""

    greens: tuple[float, float]
    offset: float

    @property
    def cycle(self) -> float:
        """Seconds until everything repeats."""
        return sum(self.greens) + 2 * (YELLOW_S + CLEARING_S) + WALK_S


class Signals:
    """The signals of a city. Junctions' programs favour the wider street."""

    def __init__(self, city: CityPlan) -> None:
        self._city = city
        self.program = lru_cache(maxsize=None)(self._program)

    def _program(self, node: tuple[int, int]) -> Program:
        rng = self._city.stream("signals", *node)
        main = int(rng.integers(2))
        greens = (16.0, 8.0) if main == 0 else (8.0, 16.0)
        return Program(greens, float(rng.uniform(0, 45)))

    def light(self, node: tuple[int, int], axis: int, time_s: float) -> Light:
        """What vehicles on a street of this axis see."""
        program = self.program(node)
        now = (time_s + program.offset) % program.cycle
        start = 0.0 if axis == 0 else program.greens[0] + YELLOW_S + CLEARING_S
        if start <= now < start + program.greens[axis]:
            return "green"
        return "yellow" if start <= now < start + program.greens[axis] + YELLOW_S else "red"

    def walk(self, node: tuple[int, int], time_s: float) -> bool:
        """Whether pedestrians may start to cross: during the first seconds of their phase, so that they get over."""
        program = self.program(node)
        now = (time_s + program.offset) % program.cycle
        return program.cycle - WALK_S <= now <= program.cycle - WALK_S + START_S
