"""Precision and true-positive errors as functions of recall, and their means: formulas of nuScenes devkit 1.2.0."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.evaluation.config import DetectionConfig
from bevcli.geometry.transforms import Array

RECALLS = np.linspace(0, 1, 101)


@dataclass(frozen=True)
class RecallCurve:
    """One class at one matching distance.

    Attributes:
        precision: (101,), at RECALLS; 0 beyond the largest recall reached.
        score: (101,), the score threshold at RECALLS; 0 beyond the largest recall reached.
    """

    precision: Array
    score: Array

    def average_precision(self, config: DetectionConfig) -> float:
        """AP: the mean precision in excess of min_precision over recalls above min_recall, scaled to 0 to 1."""
        above = self.precision[round(100 * config.min_recall) + 1 :] - config.min_precision
        return float(np.mean(np.maximum(above, 0))) / (1 - config.min_precision)

    def mean_error(self, config: DetectionConfig, scores: Array, errors: Array) -> float:
        """The running mean of an error, averaged over recalls from min_recall to the largest reached; 1 if none.

        scores: (M,), of the M true positives, descending. errors: (M,), their errors; NaN is ignored.
        """
        first, last = round(100 * config.min_recall) + 1, int(np.flatnonzero(self.score).max(initial=0))
        if last < first:
            return 1.0
        running = _running_mean(errors)
        along = np.interp(self.score[::-1], scores[::-1], running[::-1])[::-1]
        return float(np.mean(along[first : last + 1]))


def recall_curve(found: NDArray[np.bool_], scores: Array, ground_truth_count: int) -> RecallCurve:
    """The curve of P predictions.

    found: (P,), bool, whether the prediction is a true positive. scores: (P,), descending.
    """
    if not found.any():
        return RecallCurve(np.zeros_like(RECALLS), np.zeros_like(RECALLS))
    true_positives = np.cumsum(found).astype(np.float64)
    precision = true_positives / np.arange(1, len(found) + 1)
    recall = true_positives / ground_truth_count
    return RecallCurve(
        np.interp(RECALLS, recall, precision, right=0),
        np.interp(RECALLS, recall, scores, right=0),
    )


def _running_mean(values: Array) -> Array:
    known = ~np.isnan(values)
    if not known.any():
        return np.ones(len(values))  # as in the devkit
    counts = np.cumsum(known)
    return np.divide(np.nancumsum(values), counts, out=np.zeros(len(values)), where=counts > 0)
