"""Scores of detections by class; precision and errors as functions of recall as in nuScenes devkit 1.2.0."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bevcli.evaluation.config import ERRORS, DetectionConfig
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
        along = np.interp(self.score[::-1], scores[::-1], _running_mean(errors)[::-1])[::-1]
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
    return RecallCurve(*(np.interp(RECALLS, recall, values, right=0) for values in (precision, scores)))


def _running_mean(values: Array) -> Array:
    known = ~np.isnan(values)
    if not known.any():
        return np.ones(len(values))  # as in the devkit
    counts = np.cumsum(known)
    return np.divide(np.nancumsum(values), counts, out=np.zeros(len(values)), where=counts > 0)


@dataclass(frozen=True)
class ClassScores:
    """The scores of one class.

    Attributes:
        ground_truth_count: number of ground truths.
        prediction_count: number of predictions.
        recall: share of ground truth that is found at the error distance, 0 to 1; NaN without ground truth.
        aps: by matching distance in metres, average precision, 0 to 1.
        errors: by the devkit's names, mean true-positive errors; NaN where undefined.
        curves: by matching distance in metres.
    """

    ground_truth_count: int
    prediction_count: int
    recall: float
    aps: Mapping[float, float]
    errors: Mapping[str, float]
    curves: Mapping[float, RecallCurve] = field(repr=False)

    @property
    def mean_ap(self) -> float:
        """AP averaged over the matching distances."""
        return known_mean(self.aps.values())


@dataclass(frozen=True)
class ScoreTable:
    """The scores of several classes and their means; the means are NaN without any class.

    Attributes:
        classes: by name.
        mean_ap_weight: weight of mAP in NDS.
    """

    classes: Mapping[str, ClassScores]
    mean_ap_weight: float

    @property
    def ground_truth_count(self) -> int:
        """Number of ground truths."""
        return sum(scores.ground_truth_count for scores in self.classes.values())

    @property
    def prediction_count(self) -> int:
        """Number of predictions."""
        return sum(scores.prediction_count for scores in self.classes.values())

    @property
    def mean_recall(self) -> float:
        """The mean recall over the classes that have ground truth; NaN without any."""
        return known_mean(scores.recall for scores in self.classes.values())

    @property
    def mean_ap(self) -> float:
        """mAP: the mean over the classes."""
        return known_mean(scores.mean_ap for scores in self.classes.values())

    @property
    def errors(self) -> dict[str, float]:
        """The mean of each error over the classes for which it is defined; NaN without any."""
        return {name: known_mean(scores.errors[name] for scores in self.classes.values()) for name in ERRORS}

    @property
    def error_scores(self) -> dict[str, float]:
        """Each error as a score: 1 - error, at least 0."""
        return {name: value if math.isnan(value) else max(0.0, 1 - value) for name, value in self.errors.items()}

    @property
    def nd_score(self) -> float:
        """NDS, the nuScenes detection score: the weighted mean of mAP and of all defined error scores."""
        known = [score for score in self.error_scores.values() if not math.isnan(score)]
        return (self.mean_ap_weight * self.mean_ap + sum(known)) / (self.mean_ap_weight + len(known))

    def of_classes_with_ground_truth(self) -> ScoreTable:
        """The table of only those classes that have ground truth."""
        kept = {name: scores for name, scores in self.classes.items() if scores.ground_truth_count}
        return ScoreTable(kept, self.mean_ap_weight)


def known_mean(values: Iterable[float]) -> float:
    """The mean of the values that are not NaN; NaN without any."""
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan
