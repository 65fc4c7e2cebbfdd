"""Which track each object is matched to, frame by frame, at one score threshold."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from bevcli.evaluation.tracking.tracked_boxes import Indices, TrackedBoxes
from bevcli.geometry.transforms import Array

MISS, MATCH, SWITCH = 0, 1, 2
Pair = tuple[int, int, float]  # box of the ground truth, box of the predictions, distance in metres


@dataclass(frozen=True)
class NearPairs:
    """All pairs of a ground-truth box and a prediction of one frame that are close enough to match.

    Attributes:
        truths: (K,) indices into the ground truth, rising.
        predictions: (K,) indices into the predictions.
        distances: (K,) distance of the centres on the ground, metres.
    """

    truths: Indices
    predictions: Indices
    distances: Array


@dataclass(frozen=True)
class Association:
    """The result for every ground-truth box of a class.

    Attributes:
        kinds: (G,) MISS, MATCH or SWITCH (a match to another track than the object's last one).
        partners: (G,) index of the matched prediction, -1 for a miss.
        distances: (G,) distance to the partner in metres, NaN for a miss.
    """

    kinds: NDArray[np.int8]
    partners: Indices
    distances: Array


def near_pairs(truth: TrackedBoxes, predictions: TrackedBoxes, limit_m: float) -> NearPairs:
    """The pairs of each frame whose centres are closer than the limit on the ground."""
    frame_count = int(max(truth.frames.max(initial=-1), predictions.frames.max(initial=-1))) + 1
    bounds = np.arange(frame_count + 1)
    of_truth, of_predictions = (np.searchsorted(side.frames, bounds) for side in (truth, predictions))
    parts = []
    for frame in np.flatnonzero((np.diff(of_truth) > 0) & (np.diff(of_predictions) > 0)):
        g, p = of_truth[frame], of_predictions[frame]
        offsets = truth.xy[g : of_truth[frame + 1], None] - predictions.xy[None, p : of_predictions[frame + 1]]
        distances = np.hypot(offsets[..., 0], offsets[..., 1])
        rows, columns = np.nonzero(distances < limit_m)
        parts.append((rows + g, columns + p, distances[rows, columns]))
    if not parts:
        return NearPairs(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    return NearPairs(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def associate(
    truth: TrackedBoxes, predictions: TrackedBoxes, pairs: NearPairs, threshold: float = -np.inf
) -> Association:
    """Matches the objects and the tracks of one class in the order of time.

    In each frame an object keeps the track that it was matched to last, if that is present and near. The other objects
    and tracks are matched so that as many pairs as possible arise, and among those with the least sum of distances.

    Args:
        truth: G boxes of one class.
        predictions: boxes of the same class.
        pairs: of `near_pairs`.
        threshold: predictions with a lower score are left out.
    """
    alive = predictions.scores[pairs.predictions] >= threshold
    truths, candidates, distances = pairs.truths[alive], pairs.predictions[alive], pairs.distances[alive]
    starts = np.flatnonzero(np.diff(truth.frames[truths], prepend=-1))
    rows = list(zip(truths.tolist(), candidates.tolist(), distances.tolist(), strict=True))
    objects, tracks = truth.tracks.tolist(), predictions.tracks.tolist()
    kinds, partners = np.zeros(len(truth), np.int8), np.full(len(truth), -1)
    found = np.full(len(truth), np.nan)
    memory: dict[int, int] = {}  # object -> the track that it was matched to last; objects differ between scenes
    for start, end in pairwise([*starts.tolist(), len(truths)]):
        for g, p, distance in _matches(rows[start:end], objects, tracks, memory):
            known = memory.get(objects[g], tracks[p])
            kinds[g] = MATCH if known == tracks[p] else SWITCH
            partners[g], found[g] = p, distance
            memory[objects[g]] = tracks[p]
    return Association(kinds, partners, found)


def _matches(pairs: list[Pair], objects: list[int], tracks: list[int], memory: dict[int, int]) -> list[Pair]:
    """The matches of one frame: first what is remembered, then the assignment of the rest."""
    matches: list[Pair] = []
    truths, predictions = set(), set()
    for g, p, distance in pairs:
        if memory.get(objects[g]) == tracks[p] and p not in predictions:
            matches.append((g, p, distance))
            truths.add(g)
            predictions.add(p)
    rest = [pair for pair in pairs if pair[0] not in truths and pair[1] not in predictions]
    return matches + _assignment(rest)


def _assignment(pairs: list[Pair]) -> list[Pair]:
    """As many disjoint pairs as possible, with the least sum of distances."""
    rows = {g: row for row, g in enumerate(dict.fromkeys(pair[0] for pair in pairs))}
    columns = {p: column for column, p in enumerate(dict.fromkeys(pair[1] for pair in pairs))}
    if len(rows) == len(columns) == len(pairs):
        return pairs
    most = sum(pair[2] for pair in pairs) + 1.0  # one more pair is always worth more than shorter distances
    cost = np.full((len(rows), len(columns)), most)
    chosen = {}
    for pair in pairs:
        cost[rows[pair[0]], columns[pair[1]]] = pair[2]
        chosen[rows[pair[0]], columns[pair[1]]] = pair
    found = zip(*(indices.tolist() for indices in linear_sum_assignment(cost)), strict=True)
    return [chosen[place] for place in found if place in chosen]
