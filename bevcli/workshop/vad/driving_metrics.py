"""Metrics of map lines, forecasts and planned paths, as the released code of VAD and UniAD computes them.

They take arrays and read no files.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from shapely import LineString

from bevcli.geometry.boxes import MATCH_DISTANCE_M, Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.workshop.formats.map_lines import MapLines

# Lines: average precision by Chamfer distance, after MapTR. A line is a curve: its direction, its number of points, and
# where a closed line starts do not matter.
THRESHOLDS_M = (0.5, 1.0, 1.5)
SAMPLES = 100  # points of a line that are compared
BUFFER_M = 2.0  # lines whose surroundings do not meet are not compared
NO_MATCH = -100.0


@dataclass(frozen=True)
class LineScores:
    """The scores of map lines."""

    ap: Mapping[str, Mapping[float, float]]  # class -> threshold in metres -> AP, 0 to 1; 0 without true lines
    truth_count: Mapping[str, int]  # class -> number of true lines
    frame_count: int  # number of frames

    @property
    def mean_by_class(self) -> dict[str, float]:
        """Class -> mean over the thresholds."""
        return {name: float(np.mean(list(of_class.values()))) for name, of_class in self.ap.items()}

    @property
    def mean_ap(self) -> float:
        """Mean over classes and thresholds."""
        return float(np.mean(list(self.mean_by_class.values())))


@dataclass(frozen=True)
class _Curve:
    """A line as it is compared."""

    points: Array  # (P, 2)

    @cached_property
    def samples(self) -> Array:
        """(SAMPLES, 2), equally spaced along the line."""
        steps = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        at = np.linspace(0, along[-1], SAMPLES)
        return np.stack([np.interp(at, along, axis) for axis in self.points.T], axis=-1)

    @cached_property
    def surroundings(self):  # type: ignore[no-untyped-def]
        """The area around the line, with flat ends and mitred joins."""
        return LineString(self.points).buffer(BUFFER_M, cap_style="flat", join_style="mitre")


def evaluate_lines(pairs: Sequence[tuple[MapLines, MapLines]], classes: Sequence[str]) -> LineScores:
    """Score pairs of lines (predictions with scores, truth), one pair a frame, both in the same frame of reference."""
    ap, counts = {}, {}
    for name in classes:
        frames = [
            (_curves(predicted, name), _scores(predicted, name), _curves(true, name)) for predicted, true in pairs
        ]
        counts[name] = sum(len(true) for _, _, true in frames)
        scored = [(scores, similarity(predicted, true)) for predicted, scores, true in frames]
        ap[name] = {limit: _average_precision(scored, limit, counts[name]) for limit in THRESHOLDS_M}
    return LineScores(ap, counts, len(pairs))


def similarity(predicted: Sequence[_Curve], true: Sequence[_Curve]) -> Array:
    """(F, T) minus the Chamfer distance of each pair, metres; NO_MATCH where their surroundings do not meet."""
    result = np.full((len(predicted), len(true)), NO_MATCH)
    for row, curve in enumerate(predicted):
        for column, other in enumerate(true):
            if curve.surroundings.intersects(other.surroundings):
                distance = np.linalg.norm(curve.samples[:, None] - other.samples, axis=-1)
                result[row, column] = -(distance.min(1).mean() + distance.min(0).mean()) / 2
    return result


def _average_precision(frames: Sequence[tuple[Array, Array]], limit: float, truth_count: int) -> float:
    """Area under the precision envelope. frames: scores (F,) and similarities (F, T)."""
    scores = np.concatenate([scores for scores, _ in frames]) if frames else np.zeros(0)
    if not truth_count or not len(scores):
        return 0.0
    hits = np.concatenate([true_positives(scores, similarities, limit) for scores, similarities in frames])
    hits = hits[np.argsort(-scores, kind="stable")].cumsum()
    recall, precision = hits / truth_count, hits / np.arange(1, len(hits) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.sum(np.diff(recall, prepend=0.0) * envelope))


def true_positives(scores: Array, similarities: Array, limit: float) -> NDArray[np.bool_]:
    """(F,) whether each prediction takes a true line. The best scores choose first, and only their best true line.

    Where that is taken already, the prediction is a false positive: the second best is not tried.
    """
    hits, taken = np.zeros(len(scores), dtype=bool), set[int]()
    if not similarities.shape[1]:
        return hits
    for index in np.argsort(-scores, kind="stable"):
        best = int(similarities[index].argmax())
        hits[index] = similarities[index, best] >= -limit and best not in taken
        if hits[index]:
            taken.add(best)
    return hits


def _curves(lines: MapLines, name: str) -> list[_Curve]:
    return [_Curve(line[:, :2]) for line, label in zip(lines.points, lines.classes, strict=True) if label == name]


def _scores(lines: MapLines, name: str) -> Array:
    assert lines.scores is not None
    return lines.scores[lines.classes == name]


# Forecasts: EPA, minADE, minFDE and miss rate, after ViP3D (Gu et al. 2023). A forecast counts only where its object
# was found: detections and true objects are matched first.
MIN_SCORE = 0.6
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
    """Sums over objects of one class."""

    truths: int = 0  # true objects whose whole future is known
    hits: int = 0  # matched ones of known future whose best mode ends within HIT_M
    misses: int = 0  # those whose best mode does not
    false_positives: int = 0  # detections that match no object
    ade_m: float = 0.0  # sum of the smallest mean distances of a mode, over `ade_count` objects
    fde_m: float = 0.0  # sum of the smallest last distances of a mode, over hits and misses
    ade_count: int = 0  # matched objects with a known future, at least in part

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
        predicted = predictions.scored(MIN_SCORE)
        _count(predicted, truth, match(predicted, truth), sums)
    return sums


def match(predicted: Boxes3D, truth: Boxes3D) -> NDArray[np.int64]:
    """(T,) index of the detection of each true object, -1 for none: the smallest sum of distances, in x and y."""
    distance = np.linalg.norm(predicted.centers[:, None, :2] - truth.centers[:, :2], axis=-1)
    distance[~_moves(predicted)] = UNMATCHABLE
    distance[:, ~_moves(truth)] = UNMATCHABLE
    distance[distance > MATCH_DISTANCE_M] = UNMATCHABLE
    result = np.full(len(truth), -1)
    rows, columns = linear_sum_assignment(distance)
    near = distance[rows, columns] <= MATCH_DISTANCE_M
    result[columns[near]] = rows[near]
    return result


def _moves(boxes: Boxes3D) -> NDArray[np.bool_]:
    return np.isin(boxes.classes, list(SCORED_AS))


def _count(predicted: Boxes3D, truth: Boxes3D, matches: NDArray[np.int64], sums: Mapping[str, MotionSums]) -> None:
    for index, name in enumerate(predicted.classes):
        of_class = sums.get(SCORED_AS.get(str(name), ""))
        if of_class is not None and index not in matches:
            of_class.false_positives += 1
    for index, name in enumerate(truth.classes):
        of_class = sums.get(SCORED_AS.get(str(name), ""))
        if of_class is None:
            continue
        assert truth.futures is not None
        way = truth.futures[index, 0, :, 1:]  # (T, 2)
        steps = int(np.isfinite(way).all(-1).sum())
        of_class.truths += steps == len(way)
        if matches[index] >= 0 and steps:
            assert predicted.futures is not None
            _add(of_class, predicted.futures[matches[index], ..., 1:], way, steps)


def _add(sums: MotionSums, modes: np.ndarray, way: np.ndarray, steps: int) -> None:
    """Count a matched object. modes: (M, T, 2). way: (T, 2), of which the first `steps` positions are compared."""
    distance = np.linalg.norm(modes[:, :steps] - way[:steps], axis=-1)  # (M, steps)
    sums.ade_m += float(distance.mean(1).min())
    sums.ade_count += 1
    if steps == len(way):
        last = float(distance[:, -1].min())
        sums.fde_m += last
        sums.hits += last <= HIT_M
        sums.misses += last > HIT_M


def _ratio(amount: float, count: float) -> float:
    return amount / count if count else math.nan


# Planned paths: distance to the driven one, and collisions, in the two conventions of published tables. ST-P3 and VAD
# state the mean up to a horizon, UniAD the value at the horizon. Numbers of the first are much smaller for the same
# path. UniAD looks at vehicles only, the others also at pedestrians. Both turn neither the vehicle nor its footprint,
# and both count no collision in a step where the driven path has one.
CELL_M = 0.5
CELLS = 200
# Cells of the vehicle, 4.084 x 1.85 m and 0.5 m ahead of the lidar, counted from the corner of the map.
AHEAD, ACROSS = np.arange(97, 105), np.arange(98, 102)
NO_AGENTS = ("barrier", "traffic_cone")
HUMANS = ("pedestrian",)


@dataclass(frozen=True)
class PlannedFrame:
    """One frame with its whole future.

    All places are in metres, x to the right and y ahead of the vehicle at the frame's time.
    """

    path: Array  # (T, 2) planned places
    driven: Array  # (T, 2) places where the vehicle was
    others: Sequence[Boxes3D]  # T sets of boxes, the true objects at each step


@dataclass(frozen=True)
class PlanScores:
    """The scores of S planned paths of T steps, S > 0."""

    distances_m: Array  # (S, T), planned to driven
    collisions: NDArray[np.bool_]  # (S, T), with vehicles and pedestrians
    collisions_with_vehicles: NDArray[np.bool_]  # (S, T)
    step_s: float  # seconds of a step

    def averaged(self, values: NDArray[np.generic], seconds: float) -> float:
        """The mean over all steps up to a horizon, as ST-P3 and VAD state it. values: an attribute."""
        return float(values[:, : self._steps(seconds)].mean())

    def at(self, values: NDArray[np.generic], seconds: float) -> float:
        """The mean of the step at a horizon, as UniAD states it. values: an attribute."""
        return float(values[:, self._steps(seconds) - 1].mean())

    def _steps(self, seconds: float) -> int:
        return round(seconds / self.step_s)


def evaluate_plans(frames: Iterable[PlannedFrame], step_s: float) -> PlanScores:
    """Score planned paths, at least one, of steps of so many seconds."""
    distances, hits, with_vehicles = map(np.array, zip(*map(_score, frames), strict=True))
    return PlanScores(distances, hits, with_vehicles, step_s)


def _score(frame: PlannedFrame) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    agents = [boxes[~np.isin(boxes.classes, NO_AGENTS)] for boxes in frame.others]
    vehicles = [boxes[~np.isin(boxes.classes, HUMANS)] for boxes in agents]
    distances = np.linalg.norm(frame.path - frame.driven, axis=-1)
    hits = (collisions(frame.path, frame.driven, occupancy(boxes)) for boxes in (agents, vehicles))
    return (distances, *hits)


def occupancy(others: Sequence[Boxes3D]) -> NDArray[np.bool_]:
    """(T, CELLS, CELLS) cells that boxes cover in each step; row 0 is 50 m ahead, column 0 is 50 m to the left."""
    covered = np.zeros((len(others), CELLS, CELLS), np.uint8)
    for image, boxes in zip(covered, others, strict=True):
        corners = boxes.corners()[:, :4, :2]
        pixels = np.rint((corners * (1, -1) + CELLS * CELL_M / 2) / CELL_M).astype(np.int32)
        for rectangle in pixels:
            cv2.fillPoly(image, [rectangle], 1)
    return covered.astype(bool)


def collisions(path: Array, driven: Array, covered: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(T,) whether the planned vehicle covers an occupied cell where the driven one does not.

    path, driven: (T, 2). covered: of `occupancy`.
    """
    return hits(path, covered) & ~hits(driven, covered)


def hits(path: Array, covered: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(T,) whether the vehicle, at the places of a path (T, 2) and not turned, covers an occupied cell."""
    row = np.clip(np.trunc(CELLS - (path[:, 1:] / CELL_M + AHEAD)).astype(int), 0, CELLS - 1)  # (T, 8)
    column = np.clip(np.trunc(path[:, :1] / CELL_M + ACROSS).astype(int), 0, CELLS - 1)  # (T, 4)
    step = np.arange(len(path))[:, None, None]
    return covered[step, row[:, :, None], column[:, None]].any((1, 2))
