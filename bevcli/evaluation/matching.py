"""Which prediction finds which ground truth: greedily by score within each frame, as the nuScenes devkit does."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bevcli.evaluation.scored_boxes import ScoredBoxes
from bevcli.geometry.transforms import Array


def by_falling_score(scores: Array) -> NDArray[np.int64]:
    """(P,) the order in which predictions choose; among equal scores the later one comes first, as in the devkit."""
    return np.argsort(scores, kind="stable")[::-1]


def match(ground_truth: ScoredBoxes, predictions: ScoredBoxes, distances_m: tuple[float, ...]) -> NDArray[np.int64]:
    """Match one class's boxes by the horizontal distance of their centres, for each of D limits on its own.

    predictions: P boxes in the order of `by_falling_score`. Each takes the nearest ground truth of its frame that
    is still free, if that is closer than the limit. Returns (D, P) indices into `ground_truth`, -1 for no match.

    All frames take one step at a time: the best prediction of every frame, then the second best, and so on.
    """
    matched = np.full((len(distances_m), len(predictions)), -1)
    if not len(ground_truth) or not len(predictions):
        return matched
    frame_count = int(max(ground_truth.frames.max(), predictions.frames.max())) + 1
    slots = _slots(ground_truth.frames, frame_count)  # (F, K) indices into ground_truth, -1: empty
    rounds = _slots(predictions.frames, frame_count)  # (F, R) indices into predictions, best first
    centers = ground_truth.boxes.centers[:, :2]
    free = np.broadcast_to(slots >= 0, (len(distances_m), *slots.shape)).copy()  # (D, F, K)
    for turn in range(rounds.shape[1]):
        frames = np.flatnonzero((rounds[:, turn] >= 0) & (slots[:, 0] >= 0))
        chosen = rounds[frames, turn]
        offsets = centers[slots[frames]] - predictions.boxes.centers[chosen, None, :2]
        distance = np.hypot(offsets[..., 0], offsets[..., 1])  # (A, K)
        for row, limit in enumerate(distances_m):
            reachable = np.where(free[row, frames], distance, np.inf)
            nearest = reachable.argmin(axis=1)
            hit = reachable[np.arange(len(frames)), nearest] < limit
            free[row, frames[hit], nearest[hit]] = False
            matched[row, chosen[hit]] = slots[frames[hit], nearest[hit]]
    return matched


def _slots(frames: NDArray[np.int64], frame_count: int) -> NDArray[np.int64]:
    """(F, K) the indices of each frame's members in their order, filled up with -1."""
    counts = np.bincount(frames, minlength=frame_count)
    order = np.argsort(frames, kind="stable")
    starts = np.cumsum(counts) - counts
    table = np.full((frame_count, int(counts.max())), -1)
    table[frames[order], np.arange(len(frames)) - starts[frames[order]]] = order
    return table
