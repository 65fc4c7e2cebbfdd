"""The nuScenes detection score, as of devkit 1.2.0: AP, mAP, true-positive errors and NDS of boxes. Reads no files."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bevcli.errors import ConfigError
from bevcli.geometry.boxes import (
    MATCH_DISTANCE_M,
    OPTIONAL_COLUMNS,
    Boxes3D,
    ScoredBoxes,
    descending_scores,
    match_greedily,
)
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass
from bevcli.geometry.transforms import Array, wrap_angle

# The devkit's names of the five true-positive errors, in m, 1 - IoU, radians, m/s, 1 - accuracy.
ERRORS = ("trans_err", "scale_err", "orient_err", "vel_err", "attr_err")


@dataclass(frozen=True)
class ClassRanges:
    """The ranges of a score."""

    # by class, the distance from the ego vehicle on the ground below which it is scored, metres
    class_ranges_m: Mapping[str, float]

    def cut_at(self, max_range_m: float) -> Self:
        """The same score with all class ranges cut at max_range_m. Raises ConfigError if it is not positive."""
        if not max_range_m > 0:
            raise ConfigError(f"the largest range is not positive (expected more than 0 m, found {max_range_m:g})")
        return replace(self, class_ranges_m={name: min(m, max_range_m) for name, m in self.class_ranges_m.items()})

    def unlimited(self) -> Self:
        """The same score without class ranges: the devkit's score of boxes without an ego pose."""
        return replace(self, class_ranges_m=dict.fromkeys(self.class_ranges_m, math.inf))

    def for_frames(self, max_range_m: float | None, *, ego_pose_known: bool) -> Self:
        """The score with the ranges that hold for frames: cut at max_range_m, if any; unlimited without ego poses."""
        if max_range_m is not None:
            return self.cut_at(max_range_m)
        return self if ego_pose_known else self.unlimited()


@dataclass(frozen=True)
class DetectionConfig(ClassRanges):
    """Parameters of the detection score; the defaults are the devkit's."""

    class_ranges_m: Mapping[str, float] = field(default_factory=lambda: ranges_m(NUSCENES_CLASSES.values()))
    # the classes that are scored, by name
    classes: Mapping[str, ObjectClass] = field(default_factory=lambda: NUSCENES_CLASSES)
    # matching distances of the centres on the ground, metres; one AP each
    distances_m: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)
    error_distance_m: float = MATCH_DISTANCE_M  # the matching distance for true-positive errors and recall, metres
    min_recall: float = 0.1  # precision at lower recall is ignored, 0 to 1
    min_precision: float = 0.1  # lower precision counts as 0, 0 to 1
    mean_ap_weight: float = 5.0  # weight of mAP in NDS; each error has weight 1
    # rings around the ego vehicle for the table by range, lower end included, metres
    range_bins_m: tuple[tuple[float, float], ...] = ((0, 10), (10, 20), (20, 30), (30, 40), (40, 50))
    # for the table by visibility, lower end included; the last bin includes 1
    visibility_bins: tuple[tuple[float, float], ...] = ((0.0, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 1.0))

    @property
    def error_row(self) -> int:
        """Index of the matching distance for true-positive errors and recall."""
        return self.distances_m.index(self.error_distance_m)

    @classmethod
    def of(cls, classes: Mapping[str, ObjectClass]) -> Self:
        """The score of these classes, each within its range."""
        return cls(ranges_m(classes.values()), classes)

    def cut_at(self, max_range_m: float) -> Self:
        """The same score with all class ranges and bins cut at max_range_m. Raises ConfigError as `ClassRanges`."""
        bins = tuple((low, min(high, max_range_m)) for low, high in self.range_bins_m if low < max_range_m)
        return replace(super().cut_at(max_range_m), range_bins_m=bins)


def ranges_m(classes: Iterable[ObjectClass]) -> dict[str, float]:
    """The range of each class, by name."""
    return {object_class.name: object_class.range_m for object_class in classes}


RECALLS = np.linspace(0, 1, 101)


def gather(frames: Sequence[Boxes3D], ego_xy: Array) -> ScoredBoxes:
    """The boxes of F frames as one array.

    ego_xy: (F, 2), the ego vehicle's position in the frame of reference of each frame's boxes, metres.
    """
    indices = np.repeat(np.arange(len(frames)), [len(boxes) for boxes in frames])
    boxes = with_all_columns(Boxes3D.concatenate(map(with_all_columns, frames)))
    ranges = np.linalg.norm(boxes.centers[:, :2] - ego_xy[indices], axis=1)
    return ScoredBoxes(boxes, indices, ranges)


def with_all_columns(boxes: Boxes3D) -> Boxes3D:
    """The boxes with all optional columns but futures."""
    missing: dict[str, Any] = {
        name: np.full(len(boxes), column.unknown)
        for name, column in OPTIONAL_COLUMNS.items()
        if getattr(boxes, name) is None
    }
    return replace(boxes, futures=None, future_scores=None, **missing)


@dataclass(frozen=True)
class ClassMatches:
    """The matching of one class: G ground truths and P predictions at D matching distances."""

    name: str  # of the class
    ground_truth: ScoredBoxes  # G boxes
    predictions: ScoredBoxes  # P boxes, sorted by descending score
    matched: NDArray[np.int64]  # (D, P), the ground truth that each prediction matches, -1 for a false positive
    truth_counts: NDArray[np.bool_]  # (G,), bool, the ground truths that are scored
    counts: NDArray[np.bool_]  # (D, P), bool, the predictions that are scored

    def within(self, low_m: float, high_m: float) -> ClassMatches:
        """The same matching, scored only from low_m to below high_m from the ego vehicle.

        A true positive counts where its ground truth is, a false positive where it is itself, so that no pair is split.
        """
        sides = (self.ground_truth, self.predictions)
        return self._scored(*((side.ranges_m >= low_m) & (side.ranges_m < high_m) for side in sides))

    def visible(self, low: float, high: float) -> ClassMatches:
        """The same matching, scored only for ground truth with a visibility from low to below high, or up to 1.

        A false positive has no visibility and counts nowhere.
        """
        visibility = self.ground_truth.column("visibilities")
        inside = (visibility >= low) & (visibility < (high if high < 1 else np.inf))
        return self._scored(inside, np.zeros(len(self.predictions), dtype=bool))

    def _scored(self, truths: NDArray[np.bool_], false_positives: NDArray[np.bool_]) -> ClassMatches:
        """The same matching, scored only for these ground truths and false positives.

        truths: (G,). false_positives: (P,), which predictions count where they match nothing.
        """
        counts = np.broadcast_to(false_positives, self.matched.shape).copy()
        is_match = self.matched >= 0
        counts[is_match] = truths[self.matched[is_match]]
        return replace(self, truth_counts=truths, counts=counts)


def match_class(
    name: str, ground_truth: ScoredBoxes, predictions: ScoredBoxes, config: DetectionConfig
) -> ClassMatches:
    """Match the boxes of one class that are inside the range of the class."""
    limit = config.class_ranges_m[name]
    truth = ground_truth[(ground_truth.boxes.classes == name) & (ground_truth.ranges_m < limit)]
    predicted = predictions[(predictions.boxes.classes == name) & (predictions.ranges_m < limit)]
    predicted = predicted[descending_scores(predicted.column("scores"))]
    matched = match_greedily(truth, predicted, config.distances_m)
    return ClassMatches(name, truth, predicted, matched, np.ones(len(truth), bool), np.ones(matched.shape, bool))


@dataclass(frozen=True)
class RecallCurve:
    """One class at one matching distance."""

    precision: Array  # (101,), at RECALLS; 0 beyond the largest recall reached
    score: Array  # (101,), the score threshold at RECALLS; 0 beyond the largest recall reached

    def average_precision(self, config: DetectionConfig) -> float:
        """AP: the mean precision in excess of min_precision over recalls above min_recall, scaled to 0 to 1."""
        above = self.precision[round(100 * config.min_recall) + 1 :] - config.min_precision
        return float(np.mean(np.maximum(above, 0))) / (1 - config.min_precision)

    def mean_error(self, config: DetectionConfig, scores: Array, errors: Array | None) -> float:
        """The running mean of an error, averaged over recalls from min_recall to the largest reached; 1 if none.

        scores: (M,), of the M true positives, descending. errors: (M,), their errors; NaN is ignored. None for an error
        that is not defined, whose mean is NaN.
        """
        if errors is None:
            return math.nan
        first, last = round(100 * config.min_recall) + 1, int(np.flatnonzero(self.score).max(initial=0))
        if last < first:
            return 1.0
        counts = np.cumsum(~np.isnan(errors))
        running = np.divide(np.nancumsum(errors), counts, out=np.zeros(len(errors)), where=counts > 0)
        running = running if counts.any() else np.ones(len(errors))  # as in the devkit
        along = np.interp(self.score[::-1], scores[::-1], running[::-1])[::-1]
        return float(np.mean(along[first : last + 1]))


def recall_curve(is_match: NDArray[np.bool_], scores: Array, ground_truth_count: int) -> RecallCurve:
    """The curve of P predictions.

    is_match: (P,), bool, whether the prediction is a true positive. scores: (P,), descending.
    """
    if not is_match.any():
        return RecallCurve(np.zeros_like(RECALLS), np.zeros_like(RECALLS))
    true_positives = np.cumsum(is_match).astype(np.float64)
    precision = true_positives / np.arange(1, len(is_match) + 1)
    recall = true_positives / ground_truth_count
    return RecallCurve(*(np.interp(RECALLS, recall, values, right=0) for values in (precision, scores)))


@dataclass(frozen=True)
class ClassScores:
    """The scores of one class."""

    ground_truth_count: int  # number of ground truths
    prediction_count: int  # number of predictions
    recall: float  # share of ground truth that is found at the error distance, 0 to 1; NaN without ground truth
    aps: Mapping[float, float]  # by matching distance in metres, average precision, 0 to 1
    errors: Mapping[str, float]  # by the devkit's names, mean true-positive errors; NaN where undefined
    curves: Mapping[float, RecallCurve] = field(repr=False)  # by matching distance in metres

    @property
    def mean_ap(self) -> float:
        """AP averaged over the matching distances."""
        return known_mean(self.aps.values())


@dataclass(frozen=True)
class ScoreTable:
    """The scores of several classes and their means; the means are NaN without any class."""

    classes: Mapping[str, ClassScores]  # by name
    mean_ap_weight: float  # weight of mAP in NDS

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
        defined = [score for score in self.error_scores.values() if not math.isnan(score)]
        return (self.mean_ap_weight * self.mean_ap + sum(defined)) / (self.mean_ap_weight + len(defined))

    def of_classes_with_ground_truth(self) -> ScoreTable:
        """The table of only those classes that have ground truth."""
        kept = {name: scores for name, scores in self.classes.items() if scores.ground_truth_count}
        return ScoreTable(kept, self.mean_ap_weight)


def known_mean(values: Iterable[float]) -> float:
    """The mean of the values that are not NaN; NaN without any."""
    defined = [value for value in values if not math.isnan(value)]
    return sum(defined) / len(defined) if defined else math.nan


@dataclass(frozen=True)
class DetectionScores:
    """The scores of the boxes of some frames. Each table is computed when it is first asked for."""

    frame_count: int  # number of frames
    matches: tuple[ClassMatches, ...] = field(repr=False)  # by class, the matching
    unmeasured: tuple[str, ...]  # names of errors that are left out, because no ground truth has the quantity
    config: DetectionConfig  # parameters of the matching and of the score

    @cached_property
    def overall(self) -> ScoreTable:
        """All classes, as in the devkit."""
        return self._table(self.matches)

    @cached_property
    def by_range(self) -> dict[tuple[float, float], ScoreTable]:
        """By the radii of rings around the ego vehicle, nearest first, the classes that have ground truth there."""
        bins = self.config.range_bins_m
        return {ends: self._table_of_present(match.within(*ends) for match in self.matches) for ends in bins}

    @cached_property
    def by_visibility(self) -> dict[tuple[float, float], ScoreTable]:
        """By the ends of ranges of visibility, the classes that have such ground truth, without false positives.

        Empty where ground truth has no visibilities.
        """
        if all(np.isnan(match.ground_truth.column("visibilities")).all() for match in self.matches):
            return {}
        bins = self.config.visibility_bins
        return {ends: self._table_of_present(match.visible(*ends) for match in self.matches) for ends in bins}

    def _table_of_present(self, matches: Iterable[ClassMatches]) -> ScoreTable:
        return self._table([match for match in matches if match.truth_counts.any()])

    def _table(self, matches: Sequence[ClassMatches]) -> ScoreTable:
        scores = {match.name: _score_class(match, self.config, self.unmeasured) for match in matches}
        return ScoreTable(scores, self.config.mean_ap_weight)


def evaluate_detections(
    predictions: Sequence[Boxes3D],
    ground_truth: Sequence[Boxes3D],
    config: DetectionConfig | None = None,
    ego_xy: ArrayLike | None = None,
) -> DetectionScores:
    """Score the boxes of F frames.

    Args:
        predictions: F sets of boxes with scores.
        ground_truth: F sets of boxes, each in the frame of reference of the predictions of that frame; it may differ
            from frame to frame. Boxes with num_points 0 are left out.
        config: parameters of the score. Default: the devkit's.
        ego_xy: (F, 2), position of the ego vehicle in the frame of reference, metres; class ranges start there.
            Default: the origin, for boxes in the ego frame.

    Returns:
        The scores, equal to those of nuScenes devkit 1.2.0 (detection_cvpr_2019). As there, a class without ground
        truth has AP 0 and errors of 1. One difference: if no ground truth has a velocity, or none has an attribute,
        that error is NaN and left out of NDS.
    """
    assert len(predictions) == len(ground_truth)
    config = config or DetectionConfig()
    ego = np.zeros((len(predictions), 2)) if ego_xy is None else np.asarray(ego_xy, dtype=np.float64)
    # Boxes without points are left out on both sides, as in the devkit: then ground truth used as predictions has a
    # perfect score.
    sides = (gather(side, ego) for side in (ground_truth, predictions))
    truth, predicted = (side[side.column("num_points") != 0] for side in sides)
    matches = tuple(match_class(name, truth, predicted, config) for name in config.class_ranges_m)
    unknown = {"vel_err": np.isnan(truth.boxes.velocities).any(axis=1), "attr_err": truth.column("attributes") == ""}
    unmeasured = tuple(name for name, is_unknown in unknown.items() if len(truth) and is_unknown.all())
    return DetectionScores(len(predictions), matches, unmeasured, config)


def _score_class(matches: ClassMatches, config: DetectionConfig, unmeasured: tuple[str, ...]) -> ClassScores:
    truth_count = int(matches.truth_counts.sum())
    scores = matches.predictions.column("scores")
    curves = {
        distance: recall_curve(matched[counts] >= 0, scores[counts], truth_count)
        for distance, matched, counts in zip(config.distances_m, matches.matched, matches.counts, strict=True)
    }
    row = config.error_row
    hits = np.flatnonzero(matches.counts[row] & (matches.matched[row] >= 0))
    errors, curve = true_positive_errors(matches, hits, config, unmeasured), curves[config.error_distance_m]
    return ClassScores(
        ground_truth_count=truth_count,
        prediction_count=int(matches.counts[row].sum()),
        recall=len(hits) / truth_count if truth_count else float("nan"),
        aps={distance: curve.average_precision(config) for distance, curve in curves.items()},
        errors={name: curve.mean_error(config, scores[hits], values) for name, values in errors.items()},
        curves=curves,
    )


def true_positive_errors(
    matches: ClassMatches, hits: NDArray[np.int64], config: DetectionConfig, unmeasured: Iterable[str]
) -> dict[str, Array | None]:
    """The errors of the true positives of one class by the devkit's names, each (M,); None where not defined.

    hits: (M,), indices of predictions that match a ground truth at the error distance. unmeasured: as in
    `DetectionScores`.
    """
    object_class = config.classes[matches.name]
    truths = matches.ground_truth[matches.matched[config.error_row][hits]]
    errors = _pair_errors(truths, matches.predictions[hits], symmetric=object_class.symmetric)
    return dict(errors) | dict.fromkeys((*object_class.undefined_errors, *unmeasured))


def _pair_errors(truths: ScoredBoxes, predictions: ScoredBoxes, *, symmetric: bool) -> dict[str, Array]:
    """The five errors of M matched pairs of one class, each (M,), by the devkit's names.

    trans_err: distance of the centres on the ground, metres.
    scale_err: 1 - IoU of the boxes with the same centre and heading.
    orient_err: angle between the headings, radians; with symmetric, front and back are the same.
    vel_err: m/s; NaN where ground truth has no velocity.
    attr_err: 0 for the right attribute, 1 for a wrong one; NaN where ground truth has none.
    """
    truth, predicted, attributes = truths.boxes, predictions.boxes, truths.column("attributes")
    offsets = predicted.centers[:, :2] - truth.centers[:, :2]
    intersection = np.minimum(truth.sizes_lwh, predicted.sizes_lwh).prod(axis=1)
    union = truth.sizes_lwh.prod(axis=1) + predicted.sizes_lwh.prod(axis=1) - intersection
    half_turns = 2 if symmetric else 1
    turn = wrap_angle(half_turns * (truth.yaws - predicted.yaws)) / half_turns
    errors = (
        np.hypot(offsets[:, 0], offsets[:, 1]),
        1 - intersection / union,
        np.abs(turn),
        np.linalg.norm(predicted.velocities - truth.velocities, axis=1),
        np.where(attributes == "", np.nan, attributes != predictions.column("attributes")),
    )
    return dict(zip(ERRORS, errors, strict=True))
