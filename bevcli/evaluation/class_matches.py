"""Who found whom in one class, and which part of it a table is about."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bevcli.evaluation.config import DetectionConfig
from bevcli.evaluation.matching import by_falling_score, match
from bevcli.evaluation.scored_boxes import ScoredBoxes
from bevcli.geometry.transforms import Array


@dataclass(frozen=True)
class ClassMatches:
    """One class: G ground truths and P predictions by falling score.

    matched: (D, P) at each matching distance, the index of the ground truth that a prediction found, -1 for none.
    truth_counts: (G,) and counts: (D, P), bool, the boxes that are scored here.
    """

    name: str
    ground_truth: ScoredBoxes
    predictions: ScoredBoxes
    matched: NDArray[np.int64]
    truth_counts: NDArray[np.bool_]
    counts: NDArray[np.bool_]

    def within(self, low_m: float, high_m: float) -> ClassMatches:
        """Only what lies from low_m to below high_m from the ego vehicle.

        A hit belongs where its ground truth is and a false alarm where it is itself: no pair is torn apart.
        """
        truth_inside = _inside(self.ground_truth.ranges_m, low_m, high_m)
        alarm_inside = np.broadcast_to(_inside(self.predictions.ranges_m, low_m, high_m), self.matched.shape)
        hit = self.matched >= 0
        counts = alarm_inside.copy()
        counts[hit] = truth_inside[self.matched[hit]]
        return replace(self, truth_counts=truth_inside, counts=counts)

    def found(self, row: int) -> NDArray[np.bool_]:
        """(G,) which ground truths are found at the matching distance number `row`."""
        found = np.zeros(len(self.ground_truth), dtype=bool)
        found[self.matched[row][self.matched[row] >= 0]] = True
        return found


def match_class(name: str, truth: ScoredBoxes, found: ScoredBoxes, config: DetectionConfig) -> ClassMatches:
    """Match the boxes of one class that are near enough to be scored."""
    limit = config.class_ranges_m[name]
    truth = truth[(truth.boxes.classes == name) & (truth.ranges_m < limit)]
    found = found[(found.boxes.classes == name) & (found.ranges_m < limit)]
    assert found.boxes.scores is not None
    found = found[by_falling_score(found.boxes.scores)]
    matched = match(truth, found, config.distances_m)
    return ClassMatches(name, truth, found, matched, np.ones(len(truth), bool), np.ones(matched.shape, bool))


def _inside(values: Array, low: float, high: float) -> NDArray[np.bool_]:
    return (values >= low) & (values < high)
