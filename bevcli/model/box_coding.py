"""Converts box codes of the detection head to Boxes3D in the bev frame, and back.

A code is (cx, cy, log w, log l, cz, log h, sin, cos, vx, vy). As in the released code, its angle is measured clockwise
from -y: yaw = -angle - pi/2, with yaw counter-clockwise from +x.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, wrap_angle
from bevcli.model.config import ModelConfig
from bevcli.model.decoder import best_classes
from bevcli.model.step import ModelOutputs

FADING_WIDTHS = 0.7  # distance from a better box, in its widths, where fading has fallen to 1/e
SUPPORT = 0.5  # share of its score that a duplicate adds to that of another box, where neither is near 1
LEAST_EXPONENT = -60.0  # what is less adds nothing, and takes a CPU up to fifty times as long


class BestBoxes(NamedTuple):
    """The K boxes of each batch element with the best scores, by falling score.

    Attributes:
        query: (B, K), index of the object query.
        label: (B, K), index of the class.
        scores: (B, K).
        codes: (B, K, 10).
    """

    query: Tensor
    label: Tensor
    scores: Tensor
    codes: Tensor

    def decoded(self, classes: Sequence[str]) -> Boxes3D:
        """The boxes of a batch of one, bev frame. classes: of the class logits."""
        codes, scores = (column[0].double().cpu().numpy() for column in (self.codes, self.scores))
        return boxes_of_codes(codes, np.asarray(classes)[self.label[0].cpu().numpy()], scores)

    def with_scores(self, scores: Tensor) -> "BestBoxes":
        """The same boxes with other scores (B, K), by falling score."""
        scores, order = scores.topk(scores.shape[1])
        codes = self.codes.gather(1, order[..., None].expand_as(self.codes))
        return BestBoxes(self.query.gather(1, order), self.label.gather(1, order), scores, codes)

    def of_same_class(self) -> Tensor:
        """(B, K, K) float32, 1 where two boxes have the same class, else 0."""
        label = self.label.float()  # a CPU compares these three times as fast
        return (label[:, :, None] == label[:, None]).float()

    def squared_distances(self) -> Tensor:
        """(B, K, K) float32, m², between the boxes on the ground."""
        # A sum over a last axis of two takes several times as long.
        x, y = self.codes[..., :2].float().unbind(-1)
        x, y = x.contiguous(), y.contiguous()
        return (x[:, :, None] - x[:, None]).square() + (y[:, :, None] - y[:, None]).square()


def decode(outputs: ModelOutputs, config: ModelConfig) -> Boxes3D:
    """The boxes with the best scores of the last decoder layer, by falling score, bev frame; of a batch of one.

    There are at most config.decoder.max_boxes. No box is removed: training matches each object to one query. A query
    gives one box for each of its classes that is among the best scores.
    """
    best = best_boxes(outputs.class_logits[-1].detach(), outputs.box_codes[-1].detach(), config)
    return best.decoded(config.classes)


def best_boxes(class_logits: Tensor, box_codes: Tensor, config: ModelConfig) -> BestBoxes:
    """The config.decoder.max_boxes best boxes, with duplicates merged and faded as the decoder's configuration says.

    class_logits: (B, Q, classes). box_codes: (B, Q, 10).
    """
    decoder = config.decoder
    scores, query, label = best_classes(class_logits.float(), decoder.max_boxes)
    codes = box_codes.gather(1, query[..., None].expand(-1, -1, box_codes.shape[-1]))
    boxes = BestBoxes(query, label, scores, codes)
    if decoder.merge_duplicates:
        boxes = merged(boxes, decoder.merge_duplicates)
    if decoder.fade_duplicates:
        boxes = faded(boxes, decoder.fade_duplicates)
    return boxes


def merged(boxes: BestBoxes, reach: float) -> BestBoxes:
    """Each box at the mean place of the boxes of its class around it, which also raise its score.

    Several queries that find the same object err differently, so that their mean is nearer to it (weighted boxes
    fusion, Solovyev et al. 2019, does so with boxes in images). A box at a distance of d counts by its score times
    exp(-(d / (reach · size))²), where the size is the root of width times length. If those of the others add up to n, a
    score s becomes 1 - (1 - s)^(1 + SUPPORT · n).
    """
    size = boxes.codes[..., 2:4].float().mean(-1, keepdim=True).exp()  # of the logarithms of width and length
    weights = boxes.scores.clamp(min=1e-6)[:, None]
    near = (boxes.squared_distances() / -(reach * size).square()).clamp(min=LEAST_EXPONENT).exp()
    counts = near * boxes.of_same_class() * weights  # (B, K, K)
    total = counts.sum(-1)
    places = counts @ boxes.codes[..., :2].float() / total[..., None]
    moved = boxes._replace(codes=torch.cat([places.to(boxes.codes.dtype), boxes.codes[..., 2:]], dim=-1))
    return moved.with_scores(1 - (1 - boxes.scores) ** (1 + SUPPORT * (total - weights[:, 0])))


def faded(boxes: BestBoxes, share: float) -> BestBoxes:
    """Boxes near a better box of their class with lower scores, as by soft non-maximum suppression.

    At a distance of d widths of the better box, a score is multiplied by 1 - share · exp(-d / FADING_WIDTHS); of
    several better boxes, the one counts that lowers it most.
    """
    distances = boxes.squared_distances().sqrt()  # (B, better, worse)
    widths = boxes.codes[..., 2].float().exp()[:, :, None]
    lost = share * (distances / (-FADING_WIDTHS * widths)).clamp(min=LEAST_EXPONENT).exp()
    rank = torch.arange(boxes.scores.shape[1], device=lost.device)
    worse = rank[:, None] < rank  # `triu` takes as long as all the rest
    return boxes.with_scores(boxes.scores * (1 - boxes.of_same_class() * worse * lost).amin(1))


def encode(boxes: Boxes3D) -> Array:
    """Boxes in the bev frame -> codes (N, 10), the targets of training; unknown velocities are NaN."""
    length, width, height = boxes.sizes_lwh.T
    angle = -boxes.yaws - np.pi / 2
    x, y, z = boxes.centers.T
    columns = [x, y, np.log(width), np.log(length), z, np.log(height), np.sin(angle), np.cos(angle)]
    return np.concatenate([np.stack(columns, axis=-1), boxes.velocities], axis=-1)


def boxes_of_codes(code: Array, classes: np.ndarray, scores: Array) -> Boxes3D:
    """The inverse of `encode`, for codes (N, 10) with the classes (N,) and scores (N,) of their boxes."""
    angle = np.arctan2(code[:, 6], code[:, 7])
    return Boxes3D(
        centers=code[:, [0, 1, 4]],
        sizes_lwh=np.exp(code[:, [3, 2, 5]]),
        yaws=wrap_angle(-angle - np.pi / 2),
        velocities=code[:, 8:],
        classes=classes,
        scores=scores,
    )
