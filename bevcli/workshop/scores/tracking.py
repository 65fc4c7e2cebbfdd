"""The tracking metrics of the nuScenes devkit: from boxes with identities to AMOTA and what comes with it."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from statistics import median
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.matching import MATCH_DISTANCE_M
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass
from bevcli.geometry.transforms import Array
from bevcli.printing import number
from bevcli.workshop.scores.association import MATCH, MISS, SWITCH, TrackedBoxes, associate, near_pairs, scored_tracks
from bevcli.workshop.scores.config import ClassRanges, ranges_m
from bevcli.workshop.scores.inputs import Compared
from bevcli.workshop.scores.tables import Cell, Table


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

    # name -> value, see METRICS; all but amota and amotp at the threshold with the highest MOTA. NaN where a metric is
    # not defined
    metrics: Mapping[str, float]
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
        classes = self.classes.values()
        return {name: _over_classes(name, [scores.metrics[name] for scores in classes]) for name in METRICS}

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


def _over_classes(name: str, values: Sequence[float]) -> float:
    defined = np.array([value for value in values if not np.isnan(value)], dtype=np.float64)
    if not len(defined):
        return np.nan
    return float(defined.sum() if name in SUMMED else defined.mean())
