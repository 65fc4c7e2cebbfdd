"""The choice among the motions that each step may have: the road votes, and speed and yaw rate are smooth.

A step is decided when the next one is measured: Viterbi's search with a delay of one step.
"""

from collections.abc import Sequence as Items
from dataclasses import dataclass, field

import numpy as np

from bevcli.geometry.transforms import Array
from bevcli.workshop.odometry.steps import Candidate

VOTES = 6.0  # cost of a motion with 1/e of the votes
ACCELERATION, TURN = 2.0, np.radians(15.0)  # usual changes a second of speed (m/s) and of yaw rate (radians a second)

LEAP, LEAP_M = 2.0, 0.5  # m/s² and metres, of a way that differs from those of both neighbours alike
SURE = 60  # points of the road, of a motion that may leap all the same


def leaps(before: Candidate, candidate: Candidate, after: Candidate, seconds: tuple[float, float, float]) -> bool:
    """True for a motion with few points of the road whose speed is far above, or below, that of both neighbours."""
    steps = zip((before, candidate, after), seconds, strict=True)
    first, speed, last = (float(each.speed_and_rate(time)[0]) for each, time in steps)
    apart = min(abs(speed - first), abs(speed - last)) * seconds[1]
    alike = (speed - first) * (speed - last) > 0
    return candidate.road_points < SURE and alike and apart > LEAP_M + LEAP * seconds[1] ** 2


@dataclass
class Chain:
    """The undecided step, and what its motions cost so far."""

    _seconds: float = 0.0
    _candidates: Items[Candidate] = ()
    _costs: Array = field(default_factory=lambda: np.zeros(0))

    def add(self, candidates: Items[Candidate], seconds: float) -> Candidate | None:
        """Take the motions (one or more) of a step of some seconds; return that of the step before, if there is one."""
        most = max(candidate.votes for candidate in candidates)
        own = np.array([VOTES * np.log(max(most, 1e-6) / max(each.votes, 1e-6)) for each in candidates])
        before, costs = self._candidates, own
        decided = None
        if before:
            changes = np.array([[self._change(a, b, seconds) for b in candidates] for a in before])
            index = int(np.argmin(self._costs + (changes + own).min(-1)))
            decided, costs = before[index], changes[index] + own
        self._seconds, self._candidates, self._costs = seconds, candidates, costs
        return decided

    @property
    def likeliest(self) -> Candidate | None:
        """The motion of the undecided step that is the likeliest so far."""
        return self._candidates[int(np.argmin(self._costs))] if self._candidates else None

    def end(self) -> Candidate | None:
        """The motion of the last step; the chain starts anew."""
        decided = self.likeliest
        self._candidates, self._costs = (), np.zeros(0)
        return decided

    def _change(self, before: Candidate, after: Candidate, seconds: float) -> float:
        """The cost of a change of speed and yaw rate."""
        mean = (self._seconds + seconds) / 2
        slow, fast = before.speed_and_rate(self._seconds), after.speed_and_rate(seconds)
        changes = (fast - slow) / (mean * np.array([ACCELERATION, TURN]))
        return float(np.log1p(changes**2).sum())
