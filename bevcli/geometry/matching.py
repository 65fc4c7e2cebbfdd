"""Greedy matching of boxes, the rule of the nuScenes devkit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array

MATCH_DISTANCE_M = 2.0  # between centres on the ground: for errors, recall, tracks, and what is shown as found


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
