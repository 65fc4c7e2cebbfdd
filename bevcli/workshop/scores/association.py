"""The boxes of many frames with their identities, and the track that each object is matched to, frame by frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.workshop.scores.detection import gather

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class TrackedBoxes:
    """N boxes, ordered by frame."""

    frames: Indices  # (N,) index of each box's frame, rising; frames of a scene are in the order of time
    tracks: Indices  # (N,) identity, a number from 0 on; the same name in two scenes has two numbers
    xy: Array  # (N, 2) centre on the ground, metres
    classes: NDArray[np.str_]  # (N,) names
    scores: Array  # (N,) track scores; 0 for ground truth

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, selection: NDArray[Any]) -> "TrackedBoxes":
        """The boxes of a mask (N,) bool or of an index array."""
        return TrackedBoxes(*(column[selection] for column in vars(self).values()))


def scored_tracks(
    frames: Sequence[Boxes3D], stamps: Sequence[FrameStamp], ego_xy: Array, ranges_m: Mapping[str, float], side: str
) -> TrackedBoxes:
    """The boxes that are scored: in range, with points, with one score a track, and interpolated in gaps.

    frames: F frames of boxes in any order. Boxes without an identity are left out. The score of a box is its track
    score, or its score where it has none. stamps: of the frames. ego_xy: (F, 2) position of the ego vehicle in each
    frame's frame of reference, metres. ranges_m: class -> range; boxes of other classes are left out. side:
    "predictions" or "ground truth", for messages.

    Returns boxes whose `frames` count in the order of scenes and time. Raises InputError if a frame has one identity
    twice.
    """
    ranks = {scene: rank for rank, scene in enumerate(dict.fromkeys(stamp.scene for stamp in stamps))}
    order = sorted(range(len(stamps)), key=lambda index: (ranks[stamps[index].scene], stamps[index].timestamp_ns))
    sides = [frames[index] for index in order]
    scored = gather(sides, ego_xy[order])
    instances = scored.column("instances")
    limits = np.array([ranges_m.get(name, -1.0) for name in scored.boxes.classes.tolist()])
    kept = (scored.ranges_m < limits) & (scored.boxes.num_points != 0) & (instances != "")
    rows, names = scored.frames[kept], instances[kept]
    track_scores = [boxes.scores if boxes.track_scores is None else boxes.track_scores for boxes in sides]
    filled = [np.zeros(len(b)) if s is None else s for b, s in zip(sides, track_scores, strict=True)]
    scores = np.concatenate(filled)[kept]
    ordered = [stamps[index] for index in order]
    _, scenes = np.unique([stamp.scene for stamp in ordered], return_inverse=True)
    _, name_numbers = np.unique(names, return_inverse=True)
    keys = scenes[rows] * (len(names) + 1) + name_numbers
    _, tracks = np.unique(keys, return_inverse=True)
    _require_unique(rows, tracks, names, ordered, side)
    scores = _means_of_tracks(tracks, scores)
    times = np.array([stamp.timestamp_ns for stamp in ordered], dtype=np.int64)
    boxes = TrackedBoxes(rows, tracks, scored.boxes.centers[kept, :2], scored.boxes.classes[kept], scores)
    return _interpolated(boxes, times)


def _means_of_tracks(tracks: Indices, scores: Array) -> Array:
    """(N,) the mean score of each box's track, by `numpy.mean` as in the devkit.

    Its pairwise sum decides the last bit, and with it whether a box at a threshold counts.
    """
    order = np.argsort(tracks, kind="stable")
    _, starts, lengths = np.unique(tracks[order], return_index=True, return_counts=True)
    means = [np.mean(scores[order[start : start + length]]) for start, length in zip(starts, lengths, strict=True)]
    return np.array(means)[tracks]


def _require_unique(
    rows: Indices, tracks: Indices, names: NDArray[np.str_], ordered: Sequence[FrameStamp], side: str
) -> None:
    order = np.lexsort((tracks, rows))
    same = (np.diff(rows[order]) == 0) & (np.diff(tracks[order]) == 0)
    if same.any():
        box = order[int(np.argmax(same))]
        stamp = ordered[rows[box]]
        raise InputError(
            f'{side}: scene "{stamp.scene}" frame {stamp.index}: two boxes have the instance "{names[box]}" '
            "(expected one box for each object)"
        )


def _interpolated(boxes: TrackedBoxes, times_ns: Indices) -> TrackedBoxes:
    """Adds a box to every frame inside a track in which the track has none.

    As in the devkit, the weight of the right neighbour is (t_right - t) / (t_right - t_left): the nearer neighbour
    counts less in gaps of several frames. New boxes come last in their frame, by their track's first appearance.
    """
    order = np.lexsort((boxes.frames, boxes.tracks))
    left, right = order[:-1], order[1:]
    missing = np.where(boxes.tracks[left] == boxes.tracks[right], boxes.frames[right] - boxes.frames[left] - 1, 0)
    left, right = np.repeat(left, missing), np.repeat(right, missing)
    step = np.arange(len(left)) - np.repeat(np.cumsum(missing) - missing, missing) + 1
    frames = boxes.frames[left] + step
    span = times_ns[boxes.frames[right]] - times_ns[boxes.frames[left]]
    weight = (times_ns[boxes.frames[right]] - times_ns[frames]) / span
    xy = (1 - weight)[:, None] * boxes.xy[left] + weight[:, None] * boxes.xy[right]
    scores = (1 - weight) * boxes.scores[left] + weight * boxes.scores[right]
    _, first_appearance = np.unique(boxes.tracks, return_index=True)
    added = TrackedBoxes(frames, boxes.tracks[right], xy, boxes.classes[right], scores)
    added = added[np.argsort(first_appearance[added.tracks], kind="stable")]
    both = TrackedBoxes(*map(np.concatenate, zip(vars(boxes).values(), vars(added).values(), strict=True)))
    return both[np.argsort(both.frames, kind="stable")]


MISS, MATCH, SWITCH = 0, 1, 2
Pair = tuple[int, int, float]  # box of the ground truth, box of the predictions, distance in metres
Pairs = tuple[Indices, Indices, Array]  # the same of K pairs, (K,) each; the boxes of the ground truth rise


@dataclass(frozen=True)
class Association:
    """The result for every ground-truth box of a class."""

    kinds: NDArray[np.int8]  # (G,) MISS, MATCH or SWITCH (a match to another track than the object's last one)
    partners: Indices  # (G,) index of the matched prediction, -1 for a miss
    distances: Array  # (G,) distance to the partner in metres, NaN for a miss


def near_pairs(truth: TrackedBoxes, predictions: TrackedBoxes, limit_m: float) -> Pairs:
    """The pairs of each frame whose centres are closer than the limit on the ground."""
    frame_count = int(max(truth.frames.max(initial=-1), predictions.frames.max(initial=-1))) + 1
    bounds = np.arange(frame_count + 1)
    of_truth, of_predictions = (np.searchsorted(side.frames, bounds) for side in (truth, predictions))
    parts = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))]
    for frame in np.flatnonzero((np.diff(of_truth) > 0) & (np.diff(of_predictions) > 0)):
        g, p = of_truth[frame], of_predictions[frame]
        offsets = truth.xy[g : of_truth[frame + 1], None] - predictions.xy[None, p : of_predictions[frame + 1]]
        distances = np.hypot(offsets[..., 0], offsets[..., 1])
        rows, columns = np.nonzero(distances < limit_m)
        parts.append((rows + g, columns + p, distances[rows, columns]))
    truths, candidates, near = map(np.concatenate, zip(*parts, strict=True))
    return truths, candidates, near


def associate(truth: TrackedBoxes, predictions: TrackedBoxes, pairs: Pairs, threshold: float = -np.inf) -> Association:
    """Matches the objects and the tracks of one class in the order of time.

    In each frame an object keeps the track that it was matched to last, if that is present and near. The other objects
    and tracks are matched so that as many pairs as possible arise, and among those with the least sum of distances.

    truth: G boxes of one class. predictions: boxes of the same class. pairs: of `near_pairs`. threshold: predictions
    with a lower score are left out.
    """
    alive = predictions.scores[pairs[1]] >= threshold
    truths, candidates, distances = (column[alive] for column in pairs)
    starts = np.flatnonzero(np.diff(truth.frames[truths], prepend=-1))
    rows = list(zip(truths.tolist(), candidates.tolist(), distances.tolist(), strict=True))
    objects, tracks = truth.tracks.tolist(), predictions.tracks.tolist()
    kinds, partners = np.zeros(len(truth), np.int8), np.full(len(truth), -1)
    matched_m = np.full(len(truth), np.nan)
    memory: dict[int, int] = {}  # object -> the track that it was matched to last; objects differ between scenes
    for start, end in pairwise([*starts.tolist(), len(truths)]):
        for g, p, distance in _matches(rows[start:end], objects, tracks, memory):
            last_track = memory.get(objects[g], tracks[p])
            kinds[g] = MATCH if last_track == tracks[p] else SWITCH
            partners[g], matched_m[g] = p, distance
            memory[objects[g]] = tracks[p]
    return Association(kinds, partners, matched_m)


def _matches(pairs: list[Pair], objects: list[int], tracks: list[int], memory: dict[int, int]) -> list[Pair]:
    """The matches of one frame: first what is remembered, then the assignment of the rest."""
    kept: dict[int, Pair] = {}  # by the box of the predictions
    for g, p, distance in pairs:
        if memory.get(objects[g]) == tracks[p]:
            kept.setdefault(p, (g, p, distance))
    truths = {g for g, _, _ in kept.values()}
    rest = [pair for pair in pairs if pair[0] not in truths and pair[1] not in kept]
    return [*kept.values(), *_assignment(rest)]


def _assignment(pairs: list[Pair]) -> list[Pair]:
    """As many disjoint pairs as possible, with the least sum of distances."""
    rows = {g: row for row, g in enumerate(dict.fromkeys(pair[0] for pair in pairs))}
    columns = {p: column for column, p in enumerate(dict.fromkeys(pair[1] for pair in pairs))}
    if len(rows) == len(columns) == len(pairs):
        return pairs
    most = sum(pair[2] for pair in pairs) + 1.0  # one more pair is always worth more than shorter distances
    cost = np.full((len(rows), len(columns)), most)
    pair_of_cell = {(rows[pair[0]], columns[pair[1]]): pair for pair in pairs}
    for cell, (_, _, distance) in pair_of_cell.items():
        cost[cell] = distance
    cells = zip(*(indices.tolist() for indices in linear_sum_assignment(cost)), strict=True)
    return [pair_of_cell[cell] for cell in cells if cell in pair_of_cell]
