"""Boxes of earlier frames: where no camera looks now they are better known than by the model, which guesses there."""

from dataclasses import dataclass, replace

import numpy as np

from bevcli.frame import Frame, Prediction
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, inverse
from bevcli.model.decoder import DecoderConfig

GUESSED = 0.5  # share of its score that a box keeps which the model puts where no camera looks
MISSED = 0.5  # share that a remembered box keeps where a camera looks and the model finds it no more
WIDTHS, LEAST_WIDTH_M = 1.0, 0.7  # within so many widths, of at least so much, two boxes of a class are one object
FORGOTTEN = 0.05  # score below which a box is not remembered


@dataclass(frozen=True)
class BoxMemory:
    """The boxes that are remembered of a frame and those before it."""

    boxes: Boxes3D  # world frame, with scores
    timestamp_ns: int  # of the frame


def remember(
    memory: BoxMemory | None, frame: Frame, prediction: Prediction, config: DecoderConfig
) -> tuple[BoxMemory, Prediction]:
    """The memory after a frame, and its prediction with the boxes that are remembered, best first.

    A remembered box moves with its velocity, and fades. It gives way to a box of the model that is the same object,
    where a camera looks or the score of that box is higher; else that box gives way.

    Args:
        memory: before the frame, None at the start.
        frame: the frame.
        prediction: of the model for it.
        config: says how fast scores fade, and how many boxes the prediction has at most.
    """
    world_from_bev = prediction.world_from_ego.matrix @ prediction.ego_from_bev
    is_seen, time_ns = frame.sees(prediction.boxes_world), frame.stamp.timestamp_ns
    new, old = _weakened(prediction.boxes, np.where(is_seen, 1.0, GUESSED)), Boxes3D.empty()
    if memory is not None and len(memory.boxes):
        old, seconds = memory.boxes, (time_ns - memory.timestamp_ns) / 1e9
        old = replace(old, centers=old.centers + seconds * np.pad(np.nan_to_num(old.velocities), ((0, 0), (0, 1))))
        share = np.exp(-seconds / config.remember_s) * np.where(frame.sees(old), MISSED, 1.0)
        old = _weakened(old, share).scored(FORGOTTEN).transformed(inverse(world_from_bev))
        old = old[(prediction.grid.cell_of(old.centers[:, :2]) >= 0).all(-1)]
        away = np.linalg.norm(old.centers[:, None, :2] - new.centers[:, :2], axis=-1)
        is_same = away < WIDTHS * np.maximum(old.sizes_lwh[:, 1:2], LEAST_WIDTH_M)
        is_same &= old.classes[:, None] == new.classes
        yields = is_seen | (_scores(new) > _scores(old)[:, None])
        old, kept = old[~(is_same & yields).any(1)], ~(is_same & ~yields).any(0)
        new, is_seen = new[kept], is_seen[kept]
    boxes = Boxes3D.concatenate([new, old])
    known = Boxes3D.concatenate([new[is_seen].scored(FORGOTTEN), old]).transformed(world_from_bev)
    best = np.argsort(-_scores(boxes), kind="stable")
    return BoxMemory(known, time_ns), replace(prediction, boxes=boxes[best[: config.max_boxes]])


def _weakened(boxes: Boxes3D, share: Array) -> Boxes3D:
    return replace(boxes, scores=_scores(boxes) * share)


def _scores(boxes: Boxes3D) -> Array:
    return np.zeros(len(boxes)) if boxes.scores is None else boxes.scores
