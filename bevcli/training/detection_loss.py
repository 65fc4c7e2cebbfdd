"""The detection loss: targets, Hungarian matching, then focal and L1 loss after each decoder layer, as published."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from bevcli.geometry.boxes import Boxes3D
from bevcli.model.box_coding import encode
from bevcli.model.config import ModelConfig
from bevcli.model.matching import focal_cost, focal_loss, hungarian_matching

VELOCITY_START = 8  # entries 8 and 9 of a box code are vx and vy
MIN_MOVING_MPS = 0.5  # slower objects count as stationary


@dataclass(frozen=True)
class DetectionTargets:
    """The G ground truth boxes of one frame.

    Attributes:
        labels: (G,) int64, indices into the model's classes.
        codes: (G, 10) float32 box codes (see `bevcli.model.box_coding`); unknown velocities are NaN.
    """

    labels: Tensor
    codes: Tensor


def detection_targets(boxes: Boxes3D, config: ModelConfig) -> DetectionTargets:
    """The `box_targets` of the boxes (ground truth, bev frame) with a centre inside the BEV grid."""
    return box_targets(boxes_inside(boxes, config), config.classes)


def boxes_inside(boxes: Boxes3D, config: ModelConfig) -> Boxes3D:
    """The boxes (ground truth, bev frame) that are `detection_targets`, in their order."""
    grid = config.bev_grid
    low, high = np.array([grid.x_range_m, grid.y_range_m, grid.z_range_m]).T
    return _learned(boxes[((boxes.centers >= low) & (boxes.centers <= high)).all(-1)], config.classes)


def box_targets(boxes: Boxes3D, classes: tuple[str, ...]) -> DetectionTargets:
    """Targets from all boxes (ground truth, bev frame) that have one of the classes and visible points."""
    kept = _learned(boxes, classes)
    labels = [classes.index(name) for name in kept.classes]
    return DetectionTargets(torch.tensor(labels, dtype=torch.int64), torch.from_numpy(encode(kept)).float())


def _learned(boxes: Boxes3D, classes: tuple[str, ...]) -> Boxes3D:
    return boxes[np.isin(boxes.classes, classes) & has_points(boxes)]


def has_points(boxes: Boxes3D) -> NDArray[np.bool_]:
    """(N,) bool, false where the ground truth counts 0 points; boxes without a count are kept."""
    return np.ones(len(boxes), dtype=bool) if boxes.num_points is None else boxes.num_points != 0


@dataclass(frozen=True)
class DetectionLossConfig:
    """Weights of the detection loss. The class and box weights apply to the matching costs too.

    Attributes:
        class_weight: of the focal loss of the classes.
        box_weight: of the L1 loss of the box codes.
        velocity_weight: of vx and vy within the L1 loss.
        moving_weight: additional factor on the velocity of moving objects (0.5 m/s or faster). If most objects are
            stationary, L1 alone is smallest for a model that predicts zero velocity everywhere.
        quality_m: with a positive value, the class target of a query with an object is exp(-d / quality_m) instead of
            1, d metres from the predicted to the true centre on the ground, so that scores rank boxes by their place.
    """

    class_weight: float = 2.0
    box_weight: float = 0.25
    velocity_weight: float = 0.2
    moving_weight: float = 1.0
    quality_m: float = 0.0

    def __post_init__(self) -> None:
        if min(vars(self).values()) < 0:
            raise ValueError("the weights and quality_m must not be negative")


def detection_loss(
    class_logits: Tensor,
    box_codes: Tensor,
    targets: Sequence[DetectionTargets],
    config: DetectionLossConfig,
    groups: int = 1,
) -> dict[str, Tensor]:
    """The weighted losses of classes and boxes, summed over L decoder layers.

    Each layer is matched anew; losses are divided by the matched boxes of the batch.

    Args:
        class_logits: (L, B, groups · Q, classes).
        box_codes: (L, B, groups · Q, 10).
        targets: B.
        groups: number of query groups, stored one after another. Each is matched on its own (Group DETR); the
            loss is the mean over the groups.
    """
    logits, codes = (_groups_as_layers(tensor, groups) for tensor in (class_logits, box_codes))
    layers = [
        assigned_loss(*layer, targets, layer_matches(*layer, targets, config), config)
        for layer in zip(logits, codes, strict=True)
    ]
    classes, boxes = torch.stack(layers).sum(0) / groups
    return {"classes": classes, "boxes": boxes}


def layer_matches(
    class_logits: Tensor, box_codes: Tensor, targets: Sequence[DetectionTargets], config: DetectionLossConfig
) -> list[tuple[Tensor, Tensor]]:
    """The queries of each of B frames that a layer matches to boxes, and the indices of these, both (K,) int64.

    class_logits: (B, Q, classes). box_codes: (B, Q, 10).
    """
    layer = zip(class_logits, box_codes, targets, strict=True)
    return [hungarian_matching(matching_costs(*element, config)) for element in layer]


def matching_costs(
    class_logits: Tensor, box_codes: Tensor, truth: DetectionTargets, config: DetectionLossConfig
) -> Tensor:
    """(Q, G) focal cost plus L1 distance of the box codes without velocity.

    class_logits: (Q, classes). box_codes: (Q, 10). truth: G boxes.
    """
    classes = focal_cost(class_logits)[:, truth.labels]
    boxes = torch.cdist(box_codes[:, :VELOCITY_START], truth.codes[:, :VELOCITY_START], p=1)
    return config.class_weight * classes + config.box_weight * boxes


def qualities_of(predicted: Tensor, truth: Tensor, quality_m: float) -> Tensor:
    """(K,) the class targets of matched box codes (K, 10): see `DetectionLossConfig.quality_m`. No gradient."""
    if not quality_m:
        return torch.ones(len(predicted), device=predicted.device)
    return torch.exp((truth[:, :2] - predicted[:, :2].detach().float()).norm(dim=-1) / -quality_m)


def box_loss(predicted: Tensor, truth: Tensor, config: DetectionLossConfig) -> Tensor:
    """() L1 loss of matched box codes, summed. Boxes of unknown velocity are left out entirely, as published.

    predicted and truth: (K, 10).
    """
    known = truth.isfinite().all(-1)
    predicted, truth = predicted[known], truth[known]
    errors = F.l1_loss(predicted, truth, reduction="none")  # (K, 10)
    moving = truth[:, VELOCITY_START:].norm(dim=-1) >= MIN_MOVING_MPS
    weights = config.velocity_weight * torch.where(moving, config.moving_weight, 1.0)
    return errors[:, :VELOCITY_START].sum() + (weights * errors[:, VELOCITY_START:].sum(-1)).sum()


def _groups_as_layers(tensor: Tensor, groups: int) -> Tensor:
    """(L, B, groups · Q, ...) -> (L · groups, B, Q, ...)."""
    return tensor.unflatten(2, (groups, -1)).movedim(2, 1).flatten(0, 1)


def assigned_loss(
    class_logits: Tensor,
    box_codes: Tensor,
    targets: Sequence[DetectionTargets],
    assignments: Sequence[tuple[Tensor, Tensor]],
    config: DetectionLossConfig,
) -> Tensor:
    """(2,) class loss of all queries and box loss of those with an object, divided by the number of the latter.

    Args:
        class_logits: (B, Q, classes).
        box_codes: (B, Q, 10).
        targets: B.
        assignments: B pairs: (K,) int64 indices of the queries with an object, and (K,) of their objects.
    """
    class_targets = torch.zeros_like(class_logits)  # (B, Q, classes)
    predicted, truths = [], []
    for element, (truth, (queries, objects)) in enumerate(zip(targets, assignments, strict=True)):
        predicted.append(box_codes[element, queries])
        truths.append(truth.codes[objects])
        qualities = qualities_of(predicted[-1], truths[-1], config.quality_m)
        class_targets[element, queries, truth.labels[objects]] = qualities.to(class_targets.dtype)
    classes = config.class_weight * focal_loss(class_logits, class_targets).sum()
    boxes = config.box_weight * box_loss(torch.cat(predicted), torch.cat(truths), config)
    return torch.stack([classes, boxes]) / max(sum(map(len, predicted)), 1)
