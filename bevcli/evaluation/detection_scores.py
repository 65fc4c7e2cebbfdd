"""What the scoring of detections yields."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from bevcli.evaluation.class_matches import ClassMatches
from bevcli.evaluation.config import ERRORS
from bevcli.evaluation.precision_recall import RecallCurve


@dataclass(frozen=True)
class ClassScores:
    """One class.

    recall: the share of ground truth found at the error distance, NaN without ground truth. aps: by matching
    distance, 0 to 1. errors: by the devkit's names, NaN where undefined. curves: by matching distance.
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
        return _mean(self.aps.values())


@dataclass(frozen=True)
class ScoreTable:
    """Classes, and what follows from them together; NaN without any class."""

    classes: Mapping[str, ClassScores]
    mean_ap_weight: float

    @property
    def mean_ap(self) -> float:
        """mAP: the mean over the classes."""
        return _mean(scores.mean_ap for scores in self.classes.values())

    @property
    def errors(self) -> dict[str, float]:
        """Each error's mean over the classes for which it is defined; NaN where there is none."""
        return {name: _mean(scores.errors[name] for scores in self.classes.values()) for name in ERRORS}

    @property
    def error_scores(self) -> dict[str, float]:
        """Each error turned into a score: 1 - error, not below 0."""
        return {name: value if math.isnan(value) else max(0.0, 1 - value) for name, value in self.errors.items()}

    @property
    def nd_score(self) -> float:
        """NDS, the nuScenes detection score: the weighted mean of mAP and the error scores that are defined."""
        known = [score for score in self.error_scores.values() if not math.isnan(score)]
        return (self.mean_ap_weight * self.mean_ap + sum(known)) / (self.mean_ap_weight + len(known))

    def of_classes_with_ground_truth(self) -> ScoreTable:
        """The same without the classes of which there is no ground truth."""
        kept = {name: scores for name, scores in self.classes.items() if scores.ground_truth_count}
        return ScoreTable(kept, self.mean_ap_weight)


@dataclass(frozen=True)
class RangeScores:
    """The classes with ground truth from low_m to below high_m from the ego vehicle."""

    low_m: float
    high_m: float
    table: ScoreTable


@dataclass(frozen=True)
class VisibilityRecall:
    """Recall at the error distance of ground truth with a visibility from low to below high (the last bin: with it).

    recalls: by class, of those that have such ground truth.
    """

    low: float
    high: float
    ground_truth_count: int
    found_count: int
    recalls: Mapping[str, float]

    @property
    def mean_recall(self) -> float:
        """The mean over the classes, NaN without any."""
        return _mean(self.recalls.values())


@dataclass(frozen=True)
class DetectionScores:
    """A score of detections.

    overall: all classes, as the devkit counts. by_range: nearest first. by_visibility: empty where ground truth
    states none. unmeasured: the errors that ground truth states for no box. matches: for plots.
    """

    frame_count: int
    overall: ScoreTable
    by_range: tuple[RangeScores, ...]
    by_visibility: tuple[VisibilityRecall, ...]
    unmeasured: tuple[str, ...]
    matches: tuple[ClassMatches, ...] = field(repr=False)

    @property
    def prediction_count(self) -> int:
        """Predictions within their classes' ranges."""
        return sum(scores.prediction_count for scores in self.overall.classes.values())

    @property
    def ground_truth_count(self) -> int:
        """Ground truths within their classes' ranges."""
        return sum(scores.ground_truth_count for scores in self.overall.classes.values())


def _mean(values: Iterable[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan
