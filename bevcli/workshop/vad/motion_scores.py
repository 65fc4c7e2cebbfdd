"""Metrics of forecasts, as VAD computes them after ViP3D (Gu et al. 2023): EPA, minADE, minFDE and miss rate.

A forecast counts only where its object was found: detections and true objects are matched first.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from bevcli.geometry.boxes import Boxes3D

MIN_SCORE = 0.6
MATCH_M = 2.0  # centres of detection and object
HIT_M = 2.0  # last place of the best mode
FALSE_POSITIVE_SHARE = 0.5
UNMATCHABLE = 1e6
# Classes that are matched, whatever the class of the other box, and the class that they are scored as.
SCORED_AS = {
    "car": "car", "truck": "car", "bus": "car", "trailer": "car", "pedestrian": "pedestrian",
    "motorcycle": "", "bicycle": "",
}  # fmt: skip
CLASSES = ("car", "pedestrian")


@dataclass
class MotionSums:
    """Sums over objects of one class.

    Attributes:
        truths: true objects whose whole future is known.
        hits: matched ones of known future whose best mode ends within HIT_M.
        misses: those whose best mode does not.
        false_positives: detections that match no object.
        ade_m: sum of the smallest mean distances of a mode, over `ade_count` objects.
        fde_m: sum of the smallest last distances of a mode, over hits and misses.
        ade_count: matched objects with a known future, at least in part.
    """

    truths: int = 0
    hits: int = 0
    misses: int = 0
    false_positives: int = 0
    ade_m: float = 0.0
    fde_m: float = 0.0
    ade_count: int = 0

    @property
    def metrics(self) -> dict[str, float]:
        """EPA (end-to-end prediction accuracy, may be negative), minADE and minFDE (metres), MR (miss rate, 0 to 1)."""
        return {
            "EPA": _ratio(self.hits - FALSE_POSITIVE_SHARE * self.false_positives, self.truths),
            "minADE": _ratio(self.ade_m, self.ade_count),
            "minFDE": _ratio(self.fde_m, self.hits + self.misses),
            "MR": _ratio(self.misses, self.hits + self.misses),
        }


def evaluate_motion(pairs: Iterable[tuple[Boxes3D, Boxes3D]]) -> dict[str, MotionSums]:
    """Class -> its scores, of pairs of boxes (predictions, truth), one pair a frame, with futures of the same steps.

    A true object has one future, NaN where it is not known.
    """
    sums = {name: MotionSums() for name in CLASSES}
    for predictions, truth in pairs:
        found = predictions.scored(MIN_SCORE)
        _count(found, truth, match(found, truth), sums)
    return sums


def match(found: Boxes3D, truth: Boxes3D) -> NDArray[np.int64]:
    """(T,) index of the detection of each true object, -1 for none: the smallest sum of distances, in x and y."""
    distance = np.linalg.norm(found.centers[:, None, :2] - truth.centers[:, :2], axis=-1)
    distance[~_moves(found)] = UNMATCHABLE
    distance[:, ~_moves(truth)] = UNMATCHABLE
    distance[distance > MATCH_M] = UNMATCHABLE
    result = np.full(len(truth), -1)
    rows, columns = linear_sum_assignment(distance)
    near = distance[rows, columns] <= MATCH_M
    result[columns[near]] = rows[near]
    return result


def _moves(boxes: Boxes3D) -> NDArray[np.bool_]:
    return np.isin(boxes.classes, list(SCORED_AS))


def _count(found: Boxes3D, truth: Boxes3D, matches: NDArray[np.int64], sums: Mapping[str, MotionSums]) -> None:
    for place, name in enumerate(found.classes):
        of_class = sums.get(SCORED_AS.get(str(name), ""))
        if of_class is not None and place not in matches:
            of_class.false_positives += 1
    for place, name in enumerate(truth.classes):
        of_class = sums.get(SCORED_AS.get(str(name), ""))
        if of_class is None:
            continue
        assert truth.futures is not None
        way = truth.futures[place, 0, :, 1:]  # (T, 2)
        known = int(np.isfinite(way).all(-1).sum())
        of_class.truths += known == len(way)
        if matches[place] >= 0 and known:
            assert found.futures is not None
            _add(of_class, found.futures[matches[place], ..., 1:], way, known)


def _add(sums: MotionSums, modes: np.ndarray, way: np.ndarray, known: int) -> None:
    """Count a matched object. modes: (M, T, 2). way: (T, 2), of which the first `known` places are compared."""
    distance = np.linalg.norm(modes[:, :known] - way[:known], axis=-1)  # (M, known)
    sums.ade_m += float(distance.mean(1).min())
    sums.ade_count += 1
    if known == len(way):
        last = float(distance[:, -1].min())
        sums.fde_m += last
        sums.hits += last <= HIT_M
        sums.misses += last > HIT_M


def _ratio(amount: float, count: float) -> float:
    return amount / count if count else math.nan
