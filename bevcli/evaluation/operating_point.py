"""Hits, misses and false alarms when each class is cut at its best score: what a user of the boxes would see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.evaluation.class_matches import ClassMatches


@dataclass(frozen=True)
class Outcome:
    """One class above its score threshold, the one with the largest F1.

    missed: (G,) bool, ground truths not found. false_alarms, hits: (P,) bool, predictions; both False below the
    threshold. threshold: NaN where nothing is kept.
    """

    matches: ClassMatches
    threshold: float
    missed: NDArray[np.bool_]
    hits: NDArray[np.bool_]
    false_alarms: NDArray[np.bool_]


def best_outcome(matches: ClassMatches, row: int) -> Outcome:
    """Cut a class where F1 (of precision and recall) is largest. row: the number of the matching distance."""
    hit = matches.matched[row] >= 0
    f1 = 2 * np.cumsum(hit) / (np.arange(1, len(hit) + 1) + len(matches.ground_truth))
    kept_count = int(f1.argmax()) + 1 if hit.any() else 0
    kept = np.arange(len(hit)) < kept_count
    missed = np.ones(len(matches.ground_truth), dtype=bool)
    missed[matches.matched[row][kept & hit]] = False
    scores = matches.predictions.boxes.scores
    assert scores is not None
    threshold = float(scores[kept_count - 1]) if kept_count else float("nan")
    return Outcome(matches, threshold, missed, kept & hit, kept & ~hit)
