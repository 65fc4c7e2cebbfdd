"""Average precision of map lines by Chamfer distance, as VAD and MapTR compute it.

A line is a curve: its direction, its number of points, and where a closed line starts do not matter.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from shapely import LineString

from bevcli.geometry.transforms import Array
from bevcli.workshop.vad.map_lines import MapLines

THRESHOLDS_M = (0.5, 1.0, 1.5)
SAMPLES = 100  # points of a line that are compared
BUFFER_M = 2.0  # lines whose surroundings do not meet are not compared
NO_MATCH = -100.0


@dataclass(frozen=True)
class LineScores:
    """The scores of map lines.

    Attributes:
        ap: class -> threshold in metres -> average precision, 0 to 1; 0 for a class without true lines.
        truth_count: class -> number of true lines.
        frame_count: number of frames.
    """

    ap: Mapping[str, Mapping[float, float]]
    truth_count: Mapping[str, int]
    frame_count: int

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
        frames = [(_curves(found, name), _scores(found, name), _curves(true, name)) for found, true in pairs]
        counts[name] = sum(len(true) for _, _, true in frames)
        scored = [(scores, similarity(found, true)) for found, scores, true in frames]
        ap[name] = {limit: _average_precision(scored, limit, counts[name]) for limit in THRESHOLDS_M}
    return LineScores(ap, counts, len(pairs))


def similarity(found: Sequence[_Curve], true: Sequence[_Curve]) -> Array:
    """(F, T) minus the Chamfer distance of each pair, metres; NO_MATCH where their surroundings do not meet."""
    result = np.full((len(found), len(true)), NO_MATCH)
    for row, one in enumerate(found):
        for column, other in enumerate(true):
            if one.surroundings.intersects(other.surroundings):
                distance = np.linalg.norm(one.samples[:, None] - other.samples, axis=-1)
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
    for place in np.argsort(-scores, kind="stable"):
        best = int(similarities[place].argmax())
        hits[place] = similarities[place, best] >= -limit and best not in taken
        if hits[place]:
            taken.add(best)
    return hits


def _curves(lines: MapLines, name: str) -> list[_Curve]:
    return [_Curve(line[:, :2]) for line, kind in zip(lines.points, lines.classes, strict=True) if kind == name]


def _scores(lines: MapLines, name: str) -> Array:
    assert lines.scores is not None
    return lines.scores[lines.classes == name]
