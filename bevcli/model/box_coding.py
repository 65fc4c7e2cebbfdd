"""Converts box codes of the detection head to Boxes3D in the bev frame, and back.

A code is (cx, cy, log w, log l, cz, log h, sin, cos, vx, vy). As in the released code, its angle is measured clockwise
from -y: yaw = -angle - pi/2, with yaw counter-clockwise from +x.
"""

import numpy as np
import torch
from torch import Tensor

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, wrap_angle
from bevcli.model.config import ModelConfig
from bevcli.model.step import ModelOutputs

FADING_WIDTHS = 0.7  # distance from a better box, in its widths, where fading has fallen to 1/e


def decode(outputs: ModelOutputs, config: ModelConfig) -> list[Boxes3D]:
    """The boxes with the best scores of the last decoder layer, by falling score, bev frame.

    One Boxes3D for each batch element, with at most config.decoder.max_boxes boxes. No box is removed: training matches
    each object to one query. A query gives one box for each of its classes that is among the best scores.
    """
    classes = np.asarray(config.classes)
    last_codes = outputs.box_codes[-1].detach()
    query, label, best = best_queries(outputs.class_logits[-1].detach(), last_codes, config)
    codes = last_codes.gather(1, query[..., None].expand(-1, -1, last_codes.shape[-1]))
    return [
        boxes_of_codes(code.double().cpu().numpy(), classes[names.cpu().numpy()], score.double().cpu().numpy())
        for code, names, score in zip(codes, label, best, strict=True)
    ]


def best_queries(class_logits: Tensor, box_codes: Tensor, config: ModelConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Query, class index and score, each (B, K), of the boxes with the K best scores, by falling score.

    class_logits: (B, Q, classes). box_codes: (B, Q, 10).
    """
    classes = len(config.classes)
    scores = class_logits.float().sigmoid().flatten(1)  # (B, Q · classes)
    best, index = scores.topk(min(config.decoder.max_boxes, scores.shape[1]))
    query, label = index // classes, index % classes
    share = config.decoder.fade_duplicates
    if share:
        places = box_codes.float().gather(1, query[..., None].expand(-1, -1, 3))  # x, y and log w
        best, order = faded_scores(places, label, best, share).topk(best.shape[1])
        query, label = query.gather(1, order), label.gather(1, order)
    return query, label, best


def faded_scores(places: Tensor, label: Tensor, scores: Tensor, share: float) -> Tensor:
    """Scores (B, K) of boxes, lower for those near a better box of their class, as soft non-maximum suppression does.

    At a distance of d widths of the better box, a score is multiplied by 1 - share · exp(-d / FADING_WIDTHS); of
    several better boxes, the one counts that lowers it most.

    places: (B, K, 3) x, y in metres and the logarithm of the width. label: (B, K). scores: (B, K), falling.
    """
    x, y, log_width = places.unbind(-1)
    squares = (x[:, :, None] - x[:, None]).square() + (y[:, :, None] - y[:, None]).square()  # (B, better, worse)
    lost = share * torch.exp(-squares.sqrt() / (FADING_WIDTHS * log_width.exp()[:, :, None]))
    same = (label[:, :, None] == label[:, None]).float().triu(1)
    return scores * (1 - same * lost).amin(1)


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
