"""Parameters of the detection score (nuScenes' detection_cvpr_2019), and greedy matching, the devkit's rule."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import ConfigError
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass
from bevcli.geometry.transforms import Array

MATCH_DISTANCE_M = 2.0  # between centres on the ground: for errors, recall, tracks, and what is shown as found
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
    """Parameters of the detection score; the defaults are the devkit's.

    Attributes:
        classes: the classes that are scored, by name.
        distances_m: matching distances of the centres on the ground, metres; one AP each.
        error_distance_m: the matching distance for true-positive errors and recall, metres.
        min_recall: precision at lower recall is ignored, 0 to 1.
        min_precision: lower precision counts as 0, 0 to 1.
        mean_ap_weight: weight of mAP in NDS; each error has weight 1.
        range_bins_m: rings around the ego vehicle for the table by range, lower end included, metres.
        visibility_bins: for the table by visibility, lower end included; the last bin includes 1.
    """

    class_ranges_m: Mapping[str, float] = field(default_factory=lambda: ranges_m(NUSCENES_CLASSES.values()))
    classes: Mapping[str, ObjectClass] = field(default_factory=lambda: NUSCENES_CLASSES)
    distances_m: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)
    error_distance_m: float = MATCH_DISTANCE_M
    min_recall: float = 0.1
    min_precision: float = 0.1
    mean_ap_weight: float = 5.0
    range_bins_m: tuple[tuple[float, float], ...] = ((0, 10), (10, 20), (20, 30), (30, 40), (40, 50))
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


@dataclass(frozen=True)
class ScoredBoxes:
    """N boxes of many frames."""

    boxes: Boxes3D  # with all optional columns
    frames: NDArray[np.int64]  # (N,), index of each box's frame
    ranges_m: Array  # (N,), distance from the ego vehicle on the ground, metres

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, selection: NDArray[Any]) -> ScoredBoxes:
        """The boxes selected by a mask (N,) bool or by indices."""
        return ScoredBoxes(*(column[selection] for column in vars(self).values()))

    def column(self, name: str) -> NDArray[Any]:
        """An optional column of the boxes."""
        values: NDArray[Any] | None = getattr(self.boxes, name)
        assert values is not None
        return values


def descending_scores(scores: Array) -> NDArray[np.int64]:
    """(P,), indices that sort by descending score; of equal scores the later one is first, as in the devkit."""
    return np.argsort(scores, kind="stable")[::-1]


def match_greedily(
    ground_truth: ScoredBoxes, predictions: ScoredBoxes, distances_m: tuple[float, ...]
) -> NDArray[np.int64]:
    """Match boxes of one class by the distance of their centres on the ground.

    ground_truth: G boxes. predictions: P boxes in the order of `descending_scores`. distances_m: D matching distances,
    each matched independently.

    Each prediction in turn takes the nearest free ground truth of its frame, if that is closer than the matching
    distance. Returns (D, P) indices into `ground_truth`, -1 without a match.

    All frames are processed together: first the best prediction of every frame, then the second best, and so on.
    """
    matched = np.full((len(distances_m), len(predictions)), -1)
    if not len(ground_truth) or not len(predictions):
        return matched
    frame_count = int(max(ground_truth.frames.max(), predictions.frames.max())) + 1
    truths_of = _indices_by_frame(ground_truth.frames, frame_count)  # (F, K)
    predictions_of = _indices_by_frame(predictions.frames, frame_count)  # (F, R), best first
    centers = ground_truth.boxes.centers[:, :2]
    free = np.broadcast_to(truths_of >= 0, (len(distances_m), *truths_of.shape)).copy()  # (D, F, K)
    for turn in range(predictions_of.shape[1]):
        frames = np.flatnonzero((predictions_of[:, turn] >= 0) & (truths_of[:, 0] >= 0))  # (A,)
        turn_rows = predictions_of[frames, turn]
        offsets = centers[truths_of[frames]] - predictions.boxes.centers[turn_rows, None, :2]
        distance = np.hypot(offsets[..., 0], offsets[..., 1])  # (A, K)
        for row, limit in enumerate(distances_m):
            candidates = np.where(free[row, frames], distance, np.inf)
            nearest = candidates.argmin(axis=1)
            is_match = candidates[np.arange(len(frames)), nearest] < limit
            free[row, frames[is_match], nearest[is_match]] = False
            matched[row, turn_rows[is_match]] = truths_of[frames[is_match], nearest[is_match]]
    return matched


def _indices_by_frame(frames: NDArray[np.int64], frame_count: int) -> NDArray[np.int64]:
    """(F, K), the indices of each frame's boxes in their order, padded with -1."""
    counts = np.bincount(frames, minlength=frame_count)
    order = np.argsort(frames, kind="stable")
    starts = np.cumsum(counts) - counts
    table = np.full((frame_count, int(counts.max())), -1)
    table[frames[order], np.arange(len(frames)) - starts[frames[order]]] = order
    return table
