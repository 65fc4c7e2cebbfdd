"""Bootstrap of frames: the scores of frames drawn with replacement, from matches that are computed once.

A resample has the scores of a data set with its frames, by the formulas of `detection`: a frame that is drawn
twice counts twice. The loops are compiled, because each of thousands of resamples has all predictions.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from bevcli.jit import njit
from bevcli.workshop.scores.detection import (
    RECALLS,
    ClassMatches,
    ClassScores,
    DetectionScores,
    ScoreTable,
    true_positive_errors,
)

SEED = 0


def draw_frames(frame_count: int, resamples: int) -> NDArray[np.int64]:
    """(R, F), how often each resample has each of F frames; F in total. Equal in every call."""
    return np.random.default_rng(SEED).multinomial(frame_count, np.full(frame_count, 1 / frame_count), size=resamples)


def resampled(detection: DetectionScores, draws: NDArray[np.int64]) -> Iterator[ScoreTable]:
    """The scores of each resample, without curves. draws: (R, F) of `draw_frames`.

    An error is left out if no ground truth of all frames has the quantity.
    """
    classes = {matches.name: _resampled_class(matches, detection, draws) for matches in detection.matches}
    for row in zip(*classes.values(), strict=True):
        yield ScoreTable(dict(zip(classes, row, strict=True)), detection.config.mean_ap_weight)


def _resampled_class(
    matches: ClassMatches, detection: DetectionScores, draws: NDArray[np.int64]
) -> Iterator[ClassScores]:
    """The scores of one class in each resample."""
    config, predictions, truth_frames = detection.config, matches.predictions, matches.ground_truth.frames
    hits = tuple(np.flatnonzero(row >= 0) for row in matches.matched)
    errors = true_positive_errors(matches, hits[config.error_row], config, detection.unmeasured)
    defined = {name: values for name, values in errors.items() if values is not None}
    of_hits = np.array(list(defined.values())).reshape(len(defined), -1)  # (E, T)
    scores = predictions.column("scores").astype(np.float64)
    limits, unknown = (round(100 * config.min_recall) + 1, config.min_precision), dict.fromkeys(errors, np.nan)
    for drawn in draws:
        copies, truth_count = drawn[predictions.frames], int(drawn[truth_frames].sum())
        aps, means = _score(copies, scores, hits, of_hits, truth_count, config.error_row, limits, RECALLS)
        by_distance = dict(zip(config.distances_m, aps.tolist(), strict=True))
        measured = dict(zip(defined, means.tolist(), strict=True))
        yield ClassScores(truth_count, len(scores), np.nan, by_distance, unknown | measured, {})


@njit(nogil=True)
def _score(copies, scores, hits, errors, truth_count, error_row, limits, recalls):  # type: ignore[no-untyped-def]
    """AP at each distance (D,), and the mean errors (E,).

    copies: (P,) int64, how often each prediction counts, in descending order of score. scores: (P,). hits: of each
    distance, indices of the true positives. errors: (E, T) of the hits at the distance `error_row`, NaN where unknown.
    limits: index of the first recall that counts, and the lowest precision.
    """
    first, min_precision = limits
    aps, means, seen = np.zeros(len(hits)), np.ones(len(errors)), np.cumsum(copies)
    for row in range(len(hits)):
        precision, at = _curve(copies, seen, scores, hits[row], truth_count, recalls)
        aps[row] = np.maximum(precision[first:] - min_precision, 0.0).mean() / (1 - min_precision)
        if row == error_row:
            for index in range(len(errors)):
                means[index] = _mean_error(copies, scores, hits[row], errors[index], at, first)
    return aps, means


@njit(nogil=True)
def _curve(copies, seen, scores, hits, truth_count, recalls):  # type: ignore[no-untyped-def]
    """Precision and score at the recalls (101,) each: between two true positives, those before and at the second."""
    precision, at = np.zeros(len(recalls)), np.zeros(len(recalls))
    hit_count, index = 0, 0
    for hit in hits:
        for copy in range(copies[hit]):
            before = seen[hit] - copies[hit] + copy  # predictions
            last_precision, last_score = 1.0, scores[hit]  # where the curve begins
            if before:
                last_precision, last_score = hit_count / before, scores[hit if copy else _last(copies, hit)]
            start, end, new = hit_count / truth_count, (hit_count + 1) / truth_count, (hit_count + 1) / (before + 1)
            while index < len(recalls) and recalls[index] < end:
                share = (recalls[index] - start) / (end - start)
                precision[index] = last_precision + share * (new - last_precision)
                at[index] = last_score + share * (scores[hit] - last_score)
                index += 1
            hit_count += 1
    if hit_count and index < len(recalls) and recalls[index] == hit_count / truth_count:
        precision[index], at[index] = hit_count / seen[-1], scores[_last(copies, len(copies))]
    return precision, at


@njit(nogil=True)
def _last(copies, end):  # type: ignore[no-untyped-def]
    """The last prediction before `end` that counts."""
    index = end - 1
    while not copies[index]:
        index -= 1
    return index


@njit(nogil=True)
def _mean_error(copies, scores, hits, errors, at, first):  # type: ignore[no-untyped-def]
    """The running mean of an error at the scores of the recalls `at`, averaged over the recalls that are reached."""
    last = 0
    for recall in range(len(at)):
        if at[recall] != 0:
            last = recall
    if last < first:
        return 1.0
    recall, reached, error_count, total, mean, result = first, 0, 0, 0.0, 0.0, 0.0
    last_score, last_mean = 0.0, 0.0
    for index, hit in enumerate(hits):
        for _ in range(copies[hit]):
            if not np.isnan(errors[index]):
                error_count, total = error_count + 1, total + errors[index]
            mean, reached = total / error_count if error_count else 0.0, reached + 1
            while recall <= last and at[recall] >= scores[hit]:
                if reached > 1 and at[recall] > scores[hit]:
                    share = (last_score - at[recall]) / (last_score - scores[hit])
                    result += last_mean + share * (mean - last_mean)
                else:
                    result += mean
                recall += 1
            last_score, last_mean = scores[hit], mean
    result += (last - recall + 1) * mean  # recalls with a lower score than the last true positive
    return result / (last - first + 1) if error_count else 1.0
