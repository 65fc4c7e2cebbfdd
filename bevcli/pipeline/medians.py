"""RunningMedian: the median of many times, in little memory."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

RATIO = 1.01  # of two neighbouring bins


@dataclass
class RunningMedian:
    """A histogram with logarithmic bins. Its median is at most 0.5 % wrong.

    Attributes:
        count: number of values.
        total_s: their sum, seconds.
        bins: place of a bin -> number of values in it; a bin is at RATIO ** place seconds.
    """

    count: int = 0
    total_s: float = 0.0
    bins: dict[int, int] = field(default_factory=dict)

    def add(self, seconds: float) -> None:
        """Adds a value. Values below 1 µs count as 1 µs."""
        place = round(math.log(max(seconds, 1e-6), RATIO))
        self.count += 1
        self.total_s += seconds
        self.bins[place] = self.bins.get(place, 0) + 1

    def value(self) -> float:
        """The median in seconds; of an even number of values the lower of the two in the middle. 0 without values."""
        before = 0
        for place in sorted(self.bins):
            before += self.bins[place]
            if 2 * before >= self.count:
                return float(RATIO**place)
        return 0.0
