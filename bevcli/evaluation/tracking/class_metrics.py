"""The tracking metrics of one class: at one score threshold, and over all recall levels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bevcli.evaluation.tracking.association import MATCH, MISS, SWITCH, Association, associate, near_pairs
from bevcli.evaluation.tracking.config import TrackingConfig
from bevcli.evaluation.tracking.tracked_boxes import Indices, TrackedBoxes
from bevcli.geometry.transforms import Array

# The metrics at one threshold, and what a class counts that reaches no recall level. None: the class's own number.
WORST = {
    "recall": 0.0, "motar": 0.0, "gt": None, "mota": 0.0, "motp": 2.0, "mt": 0.0, "ml": None, "faf": 500.0,
    "tp": 0.0, "fp": np.nan, "fn": None, "ids": np.nan, "frag": np.nan, "tid": 20.0, "lgd": 20.0,
}  # fmt: skip
WORST_AMOTA, WORST_AMOTP = 0.0, 2.0
METRICS = ("amota", "amotp", *WORST)


@dataclass(frozen=True)
class ClassTracking:
    """The tracking metrics of one class.

    Attributes:
        metrics: name -> value, see METRICS; all but amota and amotp at the threshold with the highest MOTA. NaN where a
            metric is not defined.
        levels: name -> (K,) values at the K recall levels, level 1 first: the metrics at one threshold, "confidence"
            (the threshold) and "recall_hypo" (the level). NaN where a level is not reached.
    """

    metrics: Mapping[str, float]
    levels: Mapping[str, Array]

    @property
    def best_threshold(self) -> float:
        """The score threshold with the highest MOTA; NaN where no recall level is reached."""
        mota = self.levels["mota"]
        return np.nan if np.isnan(mota).all() else float(self.levels["confidence"][np.nanargmax(mota)])


def score_class(truth: TrackedBoxes, predictions: TrackedBoxes, config: TrackingConfig) -> ClassTracking:
    """Scores the boxes of one class. Without ground truth every number is NaN."""
    names = (*WORST, "confidence", "recall_hypo")
    levels = {name: np.full(config.recall_levels, np.nan) for name in names}
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
    for threshold in np.unique(thresholds[~np.isnan(thresholds)]):
        found = metrics_at(truth, predictions, associate(truth, predictions, pairs, threshold), threshold, config)
        for name, value in found.items():
            levels[name][thresholds == threshold] = value
    return ClassTracking(_overall(truth, levels), levels)


def metrics_at(
    truth: TrackedBoxes,
    predictions: TrackedBoxes,
    association: Association,
    threshold: float,
    config: TrackingConfig,
) -> dict[str, float]:
    """The metrics at one score threshold, by the names of WORST. At least one ground-truth box is needed."""
    kept = predictions[predictions.scores >= threshold]
    counts = np.bincount(association.kinds, minlength=3)
    fn, tp, ids = int(counts[MISS]), int(counts[MATCH]), int(counts[SWITCH])
    fp = len(kept) - tp - ids
    gt = len(truth)
    recall_of_matches = tp / gt
    motar = np.nan
    if tp:
        excess = ids + fp + fn - (1 - recall_of_matches) * gt
        motar = max(0.0, 1 - excess / (recall_of_matches * gt))
    counted = np.unique(np.concatenate([truth.frames, kept.frames]))
    return {
        "recall": (tp + ids) / gt,
        "motar": motar,
        "gt": gt,
        "mota": max(0.0, 1 - (fn + ids + fp) / gt),
        "motp": float(np.nanmean(association.distances)) if tp + ids else np.nan,
        "faf": 100 * fp / len(counted),
        "tp": tp,
        "fp": fp,
        "fn": fn,
        "ids": ids,
        **_over_objects(truth, association.kinds != MISS, counted, config),
    }


def _over_objects(
    truth: TrackedBoxes, matched: Indices | np.ndarray, counted: Indices, config: TrackingConfig
) -> dict[str, float]:
    """The metrics that look at each object's whole way: mt, ml, frag, tid and lgd.

    Args:
        truth: G boxes.
        matched: (G,) bool.
        counted: the frames that hold a box of the class, rising. Durations are numbers of these frames.
    """
    order = np.lexsort((truth.frames, truth.tracks))
    _, starts, lengths = np.unique(truth.tracks[order], return_index=True, return_counts=True)
    ends = starts + lengths
    hit, frames = matched[order], np.searchsorted(counted, truth.frames[order])
    hits = np.add.reduceat(hit, starts, dtype=np.int64)
    share = hits / lengths
    places = np.flatnonzero(hit)
    owners = np.repeat(np.arange(len(starts)), lengths)[places]  # the object of each match
    first, last = (
        np.searchsorted(owners, np.arange(len(starts))),
        np.searchsorted(owners, np.arange(len(starts)), "right"),
    )
    seen = hits > 0
    first_hit, last_hit = places[first[seen]], places[last[seen] - 1]
    waits = frames[first_hit] - frames[starts[seen]]
    gaps = np.maximum(waits, frames[ends[seen] - 1] - frames[last_hit])
    same = owners[1:] == owners[:-1]
    between = (frames[places[1:]] - frames[places[:-1]] - 1)[same]
    longest = np.zeros(len(starts), dtype=np.int64)
    np.maximum.at(longest, owners[1:][same], between)
    gaps = np.maximum(gaps, longest[seen])
    period = config.frame_period_s
    return {
        "mt": int((share >= config.mostly_tracked).sum()),
        "ml": int((share < config.mostly_lost).sum()),
        "frag": int((np.diff(places)[same] > 1).sum()),
        "tid": period * float(waits.mean()) if seen.any() else np.nan,
        "lgd": period * float(gaps.mean()) if seen.any() else np.nan,
    }


def _overall(truth: TrackedBoxes, levels: Mapping[str, Array]) -> dict[str, float]:
    """The metrics at the threshold with the highest MOTA, and the means over all levels."""
    if np.isnan(levels["mota"]).all():
        return _worst(truth)
    best = int(np.nanargmax(levels["mota"]))  # the first one: the highest recall level
    motar, motp = levels["motar"], levels["motp"]
    return {
        "amota": float(np.where(np.isnan(motar), WORST_AMOTA, motar).mean()),
        "amotp": float(np.where(np.isnan(motp), WORST_AMOTP, motp).mean()),
        **{name: float(levels[name][best]) for name in WORST},
    }


def _worst(truth: TrackedBoxes) -> dict[str, float]:
    own = {"gt": len(truth), "fn": len(truth), "ml": len(np.unique(truth.tracks))}
    stated = {name: float(own[name] if value is None else value) for name, value in WORST.items()}
    return {"amota": WORST_AMOTA, "amotp": WORST_AMOTP, **stated}
