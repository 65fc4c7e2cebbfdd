"""Figures: numbers of a run's boxes that need no ground truth, and that change where the boxes become worse."""

from collections.abc import Iterator, Sequence
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
MARGIN_M = 4.0  # boxes this near the end of the range may leave it before the next frame


@dataclass(frozen=True)
class Figures:
    """Figures of a run, over all its frames. NaN where nothing could be measured.

    Attributes:
        frames: number of frames.
        confidence: mean of the 15 best scores of a frame, 0 to 1; missing boxes count as 0.
        persistence: share of boxes that are found again in the next frame where their velocity leads, 0 to 1. A box
            counts by its score; one that is d metres off counts exp(-d), one beyond 2 m not at all.
    """

    frames: int
    confidence: float
    persistence: float


def figures_of(frames: Sequence[FrameBoxes], rig: CameraRig, range_m: float) -> Figures:
    """The figures of a run.

    frames: in the order of the run, with boxes in the ego frame that have scores. rig: the cameras. range_m: boxes
    beyond this distance from the ego frame's origin are ignored.
    """
    kept = [within(frame.boxes, range_m) for frame in frames]
    scores = [np.sort(boxes_scores(boxes))[::-1][:BEST].sum() / BEST for boxes in kept]
    found = np.array([row for step in pairwise(frames) for row in _found_again(*step, range_m)]).reshape(-1, 2)
    return Figures(
        frames=len(frames),
        confidence=float(np.mean(scores)) if scores else np.nan,
        persistence=float(found.prod(axis=1).sum() / found[:, 0].sum()) if len(found) else np.nan,
    )


def within(boxes: Boxes3D, range_m: float) -> Boxes3D:
    """The boxes whose centres are nearer than a distance on the ground. boxes: in the ego frame."""
    return boxes[np.linalg.norm(boxes.centers[:, :2], axis=1) < range_m]


def boxes_scores(boxes: Boxes3D) -> Array:
    """(N,) scores; 1 where the boxes have none."""
    return np.ones(len(boxes)) if boxes.scores is None else boxes.scores


def _found_again(frame: FrameBoxes, following: FrameBoxes, range_m: float) -> Iterator[tuple[float, float]]:
    """The score of each box that is looked for in the following frame, and how well it is found there, 0 to 1."""
    if frame.stamp.scene != following.stamp.scene or frame.world_from_ego is None or following.world_from_ego is None:
        return
    seconds = (following.stamp.timestamp_ns - frame.stamp.timestamp_ns) / 1e9
    boxes = within(frame.boxes, range_m - MARGIN_M).scored(SURE)
    others = following.boxes.scored(POSSIBLE)
    moved = boxes.centers + np.c_[np.nan_to_num(boxes.velocities) * seconds, np.zeros(len(boxes))]
    there = apply(inverse(following.world_from_ego.matrix) @ frame.world_from_ego.matrix, moved)  # (N, 3)
    for center, name, score in zip(there, boxes.classes, boxes_scores(boxes), strict=True):
        of_class = others.centers[others.classes == name, :2]
        off_m = np.linalg.norm(of_class - center[:2], axis=1).min(initial=np.inf)
        yield float(score), float(np.exp(-off_m)) if off_m < NEAR_M else 0.0
