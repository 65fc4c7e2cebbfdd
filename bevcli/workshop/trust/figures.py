"""Figures: numbers of a run's boxes that need no ground truth, and that change where the boxes become worse."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.sequences.files.boxes_file import FrameBoxes

BEST = 15  # boxes of a frame whose scores `confidence` averages
SURE, POSSIBLE = 0.2, 0.1  # scores: of a box that is looked for in the next frame, and of one that may be it
NEAR_M = 2.0  # a box is found again within this distance of where its velocity leads
FEW = 0.2  # sum of the scores of a class in a frame with which it counts half in `class_certainty`
MARGIN_M = 4.0  # boxes this near the end of the range may leave it before the next frame


@dataclass(frozen=True)
class Figures:
    """Figures of a run, over all its frames. NaN where nothing could be measured.

    Attributes:
        frames: number of frames.
        confidence: mean of the 15 best scores of a frame, 0 to 1; missing boxes count as 0.
        certainty: mean score of all boxes, each weighted by the square of its score, 0 to 1. It does not depend on how
            many objects there are.
        class_certainty: certainty of the boxes of each class, the mean over classes. A class counts fully where many
            boxes have a score of 0.2 or more, and less the fewer there are. 0 without such boxes.
        persistence: share of boxes that are found again in the next frame where their velocity leads, 0 to 1. A box
            counts by its score; one that drifts v m/s counts exp(-v / 2), one beyond 2 m not at all. 0 without boxes.
        size_change: mean relative change of length, width and height of a box that is found again.
        unseen: share of the boxes with a score of 0.2 or more whose centre no camera sees, 0 to 1.
    """

    frames: int
    confidence: float
    certainty: float
    class_certainty: float
    persistence: float
    size_change: float
    unseen: float


def figures_of(frames: Sequence[FrameBoxes], rig: CameraRig, range_m: float) -> Figures:
    """The figures of a run.

    frames: in the order of the run, with boxes in the ego frame that have scores. rig: the cameras. range_m: boxes
    beyond this distance from the ego frame's origin are ignored.
    """
    kept = [within(frame.boxes, range_m) for frame in frames]
    every = Boxes3D.concatenate(kept)
    best = [np.sort(scores_of(boxes))[-BEST:].sum() / BEST for boxes in kept]
    sure = every.scored(SURE).centers
    seen = np.any([np.zeros(len(sure), dtype=bool), *(camera.sees(sure) for camera in rig.cameras)], axis=0)
    steps = [_found_again(*step, range_m) for step in pairwise(frames) if _follows(*step)]
    score, closeness, change = np.concatenate([*steps, np.zeros((3, 0))], axis=1)
    return Figures(
        frames=len(frames),
        confidence=_mean(np.array(best)),
        certainty=_certainty(scores_of(every)),
        class_certainty=_class_certainty(every, len(frames)),
        persistence=0.0 if steps and not len(score) else _mean(closeness, score),
        size_change=_mean(change[closeness > 0], score[closeness > 0]),
        unseen=_mean(~seen * 1.0),
    )


def _certainty(scores: Array) -> float:
    return _mean(scores, scores**2) if len(scores) else 0.0


def _class_certainty(boxes: Boxes3D, frames: int) -> float:
    scores = scores_of(boxes)
    of_classes = [scores[boxes.classes == name] for name in np.unique(boxes.classes)]
    amounts = np.array([each[each >= SURE].sum() / frames for each in of_classes])
    weights = amounts / (amounts + FEW)
    return _mean(np.array([_certainty(each) for each in of_classes]), weights) if weights.any() else 0.0


def within(boxes: Boxes3D, range_m: float) -> Boxes3D:
    """The boxes whose centres are nearer than a distance on the ground. boxes: in the ego frame."""
    return boxes[np.linalg.norm(boxes.centers[:, :2], axis=1) < range_m]


def scores_of(boxes: Boxes3D) -> Array:
    """(N,) scores; 1 where the boxes have none."""
    return np.ones(len(boxes)) if boxes.scores is None else boxes.scores


def _mean(values: Array, weights: Array | None = None) -> float:
    """The weighted mean; NaN without weight."""
    weights = np.ones(len(values)) if weights is None else weights
    return float(values @ weights / weights.sum()) if weights.sum() > 0 else np.nan


def _follows(frame: FrameBoxes, following: FrameBoxes) -> bool:
    """Boxes of a frame can be looked for in the one that follows."""
    is_known = frame.world_from_ego is not None and following.world_from_ego is not None
    return is_known and frame.stamp.scene == following.stamp.scene


def _found_again(frame: FrameBoxes, following: FrameBoxes, range_m: float) -> Array:
    """(3, N) of each box that is looked for in the following frame: score, closeness 0 to 1, change of its size."""
    assert frame.world_from_ego is not None
    assert following.world_from_ego is not None
    seconds = (following.stamp.timestamp_ns - frame.stamp.timestamp_ns) / 1e9
    boxes, others = within(frame.boxes, range_m - MARGIN_M).scored(SURE), following.boxes.scored(POSSIBLE)
    if not len(boxes) or not len(others):
        return np.stack([scores_of(boxes), *np.zeros((2, len(boxes)))])
    moved = boxes.centers + np.c_[np.nan_to_num(boxes.velocities) * seconds, np.zeros(len(boxes))]
    there = apply(inverse(following.world_from_ego.matrix) @ frame.world_from_ego.matrix, moved)  # (N, 3)
    off_m = np.linalg.norm(there[:, None, :2] - others.centers[:, :2], axis=2)  # (N, M)
    off_m[boxes.classes[:, None] != others.classes] = np.inf
    nearest, off_m = off_m.argmin(axis=1), off_m.min(axis=1)
    change = np.abs(np.log(others.sizes_lwh[nearest] / boxes.sizes_lwh)).mean(axis=1)
    return np.stack([scores_of(boxes), np.where(off_m < NEAR_M, np.exp(-off_m / seconds / 2), 0), change])
