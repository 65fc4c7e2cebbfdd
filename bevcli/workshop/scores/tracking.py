"""The tracking metrics of the nuScenes devkit: from boxes with identities to AMOTA and what comes with it."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from statistics import median
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import MATCH_DISTANCE_M, Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass
from bevcli.geometry.transforms import Array
from bevcli.printing import number
from bevcli.workshop.scores.detection import ClassRanges, gather, ranges_m
from bevcli.workshop.scores.inputs import Compared
from bevcli.workshop.scores.tables import Cell, Table

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


@dataclass(frozen=True)
class TrackingConfig(ClassRanges):
    """All parameters of the tracking metrics; the defaults are the nuScenes devkit's (tracking_nips_2019)."""

    class_ranges_m: Mapping[str, float] = field(default_factory=lambda: _tracked_ranges_m(NUSCENES_CLASSES))
    match_distance_m: float = MATCH_DISTANCE_M  # centres that are closer on the ground can match
    recall_levels: int = 40  # number of recall levels from `min_recall` to 1 over which AMOTA and AMOTP are means
    min_recall: float = 0.1  # the lowest recall level
    frame_period_s: float = 0.5  # duration that one frame counts in tid and lgd, whatever the timestamps are
    mostly_tracked: float = 0.8  # of an object that is matched in at least this share of its frames
    mostly_lost: float = 0.2  # of one that is matched in less than this share

    @classmethod
    def of(cls, classes: Mapping[str, ObjectClass]) -> Self:
        """The metrics of those of these classes that are tracked, each within its range."""
        return cls(_tracked_ranges_m(classes))


def _tracked_ranges_m(classes: Mapping[str, ObjectClass]) -> dict[str, float]:
    """The ranges of the tracked classes, in the order of their names, as the devkit has them."""
    return ranges_m(classes[name] for name in sorted(classes) if classes[name].tracked)


# The metrics at one threshold, and what a class counts that reaches no recall level. None: the class's own number.
WORST = {
    "recall": 0.0, "motar": 0.0, "gt": None, "mota": 0.0, "motp": 2.0, "mt": 0.0, "ml": None, "faf": 500.0,
    "tp": 0.0, "fp": np.nan, "fn": None, "ids": np.nan, "frag": np.nan, "tid": 20.0, "lgd": 20.0,
}  # fmt: skip
WORST_AMOTA, WORST_AMOTP = 0.0, 2.0
METRICS = ("amota", "amotp", *WORST)
# Column -> metric and number of decimals, in two tables.
_QUALITY = {
    "AMOTA": ("amota", 3), "AMOTP m": ("amotp", 3), "MOTA": ("mota", 3), "MOTP m": ("motp", 3), "recall": ("recall", 3),
    "MOTAR": ("motar", 3), "GT": ("gt", 0), "MT": ("mt", 0), "ML": ("ml", 0),
}  # fmt: skip
_ERRORS = {
    "TP": ("tp", 0), "FP": ("fp", 0), "FN": ("fn", 0), "IDS": ("ids", 0), "FRAG": ("frag", 0), "FAF": ("faf", 1),
    "TID s": ("tid", 2), "LGD s": ("lgd", 2),
}  # fmt: skip


@dataclass(frozen=True)
class ClassTracking:
    """The tracking metrics of one class."""

    metrics: Mapping[str, float]  # by METRICS, most of them at the threshold with the highest MOTA; NaN if undefined
    # name -> (K,) values at the K recall levels, level 1 first: the metrics at one threshold, "confidence" (the
    # threshold) and "recall_hypo" (the level). NaN where a level is not reached
    levels: Mapping[str, Array]

    @property
    def best_threshold(self) -> float:
        """The score threshold with the highest MOTA; NaN where no recall level is reached."""
        mota = self.levels["mota"]
        return np.nan if np.isnan(mota).all() else float(self.levels["confidence"][np.nanargmax(mota)])


def score_class(truth: TrackedBoxes, predictions: TrackedBoxes, config: TrackingConfig) -> ClassTracking:
    """Scores the boxes of one class. Without ground truth every number is NaN."""
    levels = {name: np.full(config.recall_levels, np.nan) for name in (*WORST, "confidence", "recall_hypo")}
    if not len(truth):
        return ClassTracking(dict.fromkeys(METRICS, np.nan), levels)
    recalls = np.linspace(config.min_recall, 1, config.recall_levels).round(12)
    pairs = near_pairs(truth, predictions, config.match_distance_m)
    everything = associate(truth, predictions, pairs)
    matched = everything.partners[everything.kinds == MATCH]
    if not len(matched):
        return ClassTracking(_worst(truth), levels)
    scores = np.sort(predictions.scores[matched])[::-1]
    thresholds = np.interp(recalls, np.arange(1, len(scores) + 1) / len(truth), scores, right=np.nan)[::-1]
    levels["confidence"], levels["recall_hypo"] = thresholds, recalls[::-1]
    if np.isnan(thresholds).all():
        return ClassTracking(_worst(truth), levels)
    for threshold in np.unique(thresholds[~np.isnan(thresholds)]):
        kept, matches = predictions[predictions.scores >= threshold], associate(truth, predictions, pairs, threshold)
        for name, value in _metrics(truth, kept, matches.kinds, matches.distances, config).items():
            levels[name][thresholds == threshold] = value
    best = int(np.nanargmax(levels["mota"]))  # the first one: the highest recall level
    motar, motp = levels["motar"], levels["motp"]
    overall = {
        "amota": float(np.where(np.isnan(motar), WORST_AMOTA, motar).mean()),
        "amotp": float(np.where(np.isnan(motp), WORST_AMOTP, motp).mean()),
        **{name: float(levels[name][best]) for name in WORST},
    }
    return ClassTracking(overall, levels)


def _metrics(
    truth: TrackedBoxes, kept: TrackedBoxes, kinds: NDArray[np.int8], distances: Array, config: TrackingConfig
) -> dict[str, float]:
    """The metrics at one score threshold, by the names of WORST. At least one ground-truth box is needed.

    kept: the predictions above the threshold. kinds, distances: (G,) of the association of the ground truth.
    """
    counts = np.bincount(kinds, minlength=3)
    fn, tp, ids = int(counts[MISS]), int(counts[MATCH]), int(counts[SWITCH])
    fp = len(kept) - tp - ids
    gt = len(truth)
    recall = tp / gt  # of matches without switches
    motar = max(0.0, 1 - (ids + fp + fn - (1 - recall) * gt) / (recall * gt)) if tp else np.nan
    counted = np.unique(np.concatenate([truth.frames, kept.frames]))
    return {
        "recall": (tp + ids) / gt,
        "motar": motar,
        "gt": gt,
        "mota": max(0.0, 1 - (fn + ids + fp) / gt),
        "motp": float(np.nanmean(distances)) if tp + ids else np.nan,
        "faf": 100 * fp / len(counted),
        "tp": tp,
        "fp": fp,
        "fn": fn,
        "ids": ids,
        **_over_objects(truth, kinds != MISS, counted, config),
    }


def _over_objects(
    truth: TrackedBoxes, matched: NDArray[np.bool_], counted: NDArray[np.int64], config: TrackingConfig
) -> dict[str, float]:
    """The metrics that look at each object's whole way: mt, ml, frag, tid and lgd.

    truth: G boxes. matched: (G,) bool. counted: the frames that hold a box of the class, rising; durations are numbers
    of these frames.
    """
    order = np.lexsort((truth.frames, truth.tracks))
    _, starts, lengths = np.unique(truth.tracks[order], return_index=True, return_counts=True)
    ends = starts + lengths
    hit, frames = matched[order], np.searchsorted(counted, truth.frames[order])
    hits = np.add.reduceat(hit, starts, dtype=np.int64)
    share = hits / lengths
    matches = np.flatnonzero(hit)
    owners = np.repeat(np.arange(len(starts)), lengths)[matches]  # the object of each match
    seen = hits > 0
    after = np.cumsum(hits)  # of the places of each object's matches, the one after the last
    first_hit, last_hit = matches[(after - hits)[seen]], matches[after[seen] - 1]
    waits = frames[first_hit] - frames[starts[seen]]
    gaps = np.maximum(waits, frames[ends[seen] - 1] - frames[last_hit])
    same = owners[1:] == owners[:-1]
    between = (frames[matches[1:]] - frames[matches[:-1]] - 1)[same]
    longest = np.zeros(len(starts), dtype=np.int64)
    np.maximum.at(longest, owners[1:][same], between)
    gaps = np.maximum(gaps, longest[seen])
    period = config.frame_period_s
    return {
        "mt": int((share >= config.mostly_tracked).sum()),
        "ml": int((share < config.mostly_lost).sum()),
        "frag": int((np.diff(matches)[same] > 1).sum()),
        "tid": period * float(waits.mean()) if seen.any() else np.nan,
        "lgd": period * float(gaps.mean()) if seen.any() else np.nan,
    }


def _worst(truth: TrackedBoxes) -> dict[str, float]:
    counts = {"gt": len(truth), "fn": len(truth), "ml": len(np.unique(truth.tracks))}
    metrics = {name: float(counts[name] if value is None else value) for name, value in WORST.items()}
    return {"amota": WORST_AMOTA, "amotp": WORST_AMOTP, **metrics}


SUMMED = ("mt", "ml", "tp", "fp", "fn", "ids", "frag")


@dataclass(frozen=True)
class TrackingScores:
    """The tracking metrics of all classes."""

    classes: Mapping[str, ClassTracking]  # class -> its metrics
    config: TrackingConfig  # the parameters that they were computed with
    scenes: int  # number of scenes
    frames: int  # number of frames
    notes: tuple[str, ...] = ()  # differences from nuScenes, one line each

    @property
    def overall(self) -> dict[str, float]:
        """Metric -> its sum or its mean over the classes that have ground truth; NaN where no class has any."""
        overall = {}
        for name in METRICS:
            values = np.array([scores.metrics[name] for scores in self.classes.values()], dtype=np.float64)
            values = values[~np.isnan(values)]
            overall[name] = float(values.sum() if name in SUMMED else values.mean()) if len(values) else np.nan
        return overall

    def to_dict(self) -> dict[str, Any]:
        config = self.config
        content = {
            "label_metrics": {
                name: {label: scored.metrics[name] for label, scored in self.classes.items()} for name in METRICS
            },
            **self.overall,
            "best_thresholds": {name: scored.best_threshold for name, scored in self.classes.items()},
            "scenes": self.scenes,
            "frames": self.frames,
            "cfg": {
                "class_range": {name: float(limit) for name, limit in config.class_ranges_m.items()},
                "dist_th_tp": config.match_distance_m,
                "num_thresholds": config.recall_levels,
                "min_recall": config.min_recall,
            },
        }
        return {"tracking": content}

    def tables(self) -> Iterator[Table]:
        """The metrics by class, and their sums or means over the classes, in two tables; AMOTA."""
        overall = self.overall
        rows = {**{name: scored.metrics for name, scored in self.classes.items()}, "all": overall}
        switches = overall["ids"] / self.scenes if self.scenes else math.nan
        below = (
            f"\n\nAMOTA {number(overall['amota'])}   AMOTP {number(overall['amotp'])} m   "
            f"identity switches {number(switches, 1)} per scene (scenes: {self.scenes}, frames: {self.frames})"
        )
        per_scene = {"IDS per scene": switches}
        yield _table("tracks", _QUALITY, rows)
        yield replace(_table("errors of tracks", _ERRORS, rows), below=below, sums=per_scene)


def _table(name: str, columns: Mapping[str, tuple[str, int]], classes: Mapping[str, Mapping[str, float]]) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (label, *(float(values[metric]) for metric, _ in columns.values())) for label, values in classes.items()
    ]
    return Table(name, ("class", *columns), rows, {column: digits for column, (_, digits) in columns.items()})


def score_tracks(compared: Compared) -> TrackingScores:
    """The scores of the tracks. Raises InputError as `evaluate_tracking`."""
    pairs = compared.pairs
    config = TrackingConfig.of(compared.classes)
    config = config.for_frames(compared.max_range_m, ego_pose_known=pairs.ego_pose_known)
    stamps = [frame.stamp for frame in pairs.ground_truth]
    scores = evaluate_tracking(*pairs.boxes, stamps, config, pairs.ego_xy)
    return replace(scores, notes=tuple(_notes(stamps, config, pairs.frame_of_reference)))


def _notes(stamps: Sequence[FrameStamp], config: TrackingConfig, frame_of_reference: str) -> Iterator[str]:
    if frame_of_reference != "world":
        yield (
            f"tracks are scored in the {frame_of_reference} frame: gaps in tracks are interpolated there, not in the "
            "world frame"
        )
    ordered = pairwise(sorted(stamps, key=lambda stamp: (stamp.scene, stamp.timestamp_ns)))
    gaps = [(b.timestamp_ns - a.timestamp_ns) / 1e9 for a, b in ordered if a.scene == b.scene]
    if gaps and not 0.8 < median(gaps) / config.frame_period_s < 1.25:
        yield (
            f"frames are {median(gaps):.2g} s apart, but TID and LGD count {config.frame_period_s:g} s for each of "
            "them, as in the nuScenes devkit"
        )


def evaluate_tracking(
    predictions: Sequence[Boxes3D],
    ground_truth: Sequence[Boxes3D],
    stamps: Sequence[FrameStamp],
    config: TrackingConfig | None = None,
    ego_xy: Array | None = None,
) -> TrackingScores:
    """Scores tracks as the nuScenes devkit does.

    predictions: boxes of F frames with `instances` and `track_scores` (or `scores`). Boxes without an identity are left
    out. ground_truth: boxes of the same frames with `instances`, in the same frame of reference: the world, or another
    one that does not move within a scene. stamps: of the frames. ego_xy: (F, 2) position of the ego vehicle in the
    frame of reference, metres. Default: the origin.

    Raises InputError if a ground-truth box or all predictions have no identity, or a frame has one identity twice.
    """
    config = TrackingConfig() if config is None else config
    _require_identities(predictions, ground_truth, stamps, tuple(config.class_ranges_m))
    ego_xy = np.zeros((len(stamps), 2)) if ego_xy is None else ego_xy
    predicted = scored_tracks(predictions, stamps, ego_xy, config.class_ranges_m, "predictions")
    true = scored_tracks(ground_truth, stamps, ego_xy, config.class_ranges_m, "ground truth")
    classes = {
        name: score_class(true[true.classes == name], predicted[predicted.classes == name], config)
        for name in config.class_ranges_m
    }
    return TrackingScores(classes, config, len({stamp.scene for stamp in stamps}), len(stamps))


def _require_identities(
    predictions: Sequence[Boxes3D],
    ground_truth: Sequence[Boxes3D],
    stamps: Sequence[FrameStamp],
    classes: tuple[str, ...],
) -> None:
    for boxes, stamp in zip(ground_truth, stamps, strict=True):
        scored = boxes[np.isin(boxes.classes, classes)]
        without = len(scored) if scored.instances is None else int((scored.instances == "").sum())
        if without:
            raise InputError(
                f'ground truth: scene "{stamp.scene}" frame {stamp.index}: {without} of {len(scored)} boxes have no '
                '"instance" (tracking metrics need the identity of every object)'
            )
    if any(map(len, predictions)) and not any(
        boxes.instances is not None and (boxes.instances != "").any() for boxes in predictions
    ):
        raise InputError(
            'predictions: no box has an "instance" (tracking metrics need identities): use `bevcli run --track`'
        )
