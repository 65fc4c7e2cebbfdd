"""The detection loss: Hungarian matching, then focal and L1 loss, after each decoder layer, as published."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from bevcli.training.detection_targets import DetectionTargets
from bevcli.training.focal_loss import focal_cost, focal_loss
from bevcli.training.hungarian_matching import hungarian_matching

VELOCITY_START = 8  # entries 8 and 9 of a box code are vx and vy
MIN_MOVING_MPS = 0.5  # slower objects count as stationary


@dataclass(frozen=True)
class DetectionLossConfig:
    """Weights of the detection loss. The class and box weights apply to the matching costs too.

    Attributes:
        class_weight: of the focal loss of the classes.
        box_weight: of the L1 loss of the box codes.
        velocity_weight: of vx and vy within the L1 loss.
        moving_weight: additional factor on the velocity of moving objects (0.5 m/s or faster). If most objects are
            stationary, L1 alone is smallest for a model that predicts zero velocity everywhere.
    """

    class_weight: float = 2.0
    box_weight: float = 0.25
    velocity_weight: float = 0.2
    moving_weight: float = 1.0

    def __post_init__(self) -> None:
        if min(self.class_weight, self.box_weight, self.velocity_weight, self.moving_weight) < 0:
            raise ValueError("the weights must not be negative")


@dataclass(frozen=True)
class DetectionLoss:
    """Weighted scalar losses, summed over the decoder layers.

    Attributes:
        classes: () focal loss of the classes.
        boxes: () L1 loss of the box codes.
    """

    classes: Tensor
    boxes: Tensor

    @property
    def total(self) -> Tensor:
        """() the sum of both."""
        return self.classes + self.boxes


def detection_loss(
    class_logits: Tensor,
    box_codes: Tensor,
    targets: Sequence[DetectionTargets],
    config: DetectionLossConfig,
    groups: int = 1,
) -> DetectionLoss:
    """The loss of L decoder layers. Each layer is matched anew; losses are divided by the matched boxes of the batch.

    Args:
        class_logits: (L, B, groups · Q, classes).
        box_codes: (L, B, groups · Q, 10).
        targets: B.
        groups: number of query groups, stored one after another. Each is matched on its own (Group DETR); the
            loss is the mean over the groups.
    """
    logits, codes = (_groups_as_layers(tensor, groups) for tensor in (class_logits, box_codes))
    layers = [_layer_loss(*layer, targets, config) for layer in zip(logits, codes, strict=True)]
    classes, boxes = torch.stack(layers).sum(0) / groups
    return DetectionLoss(classes, boxes)


def matching_costs(
    class_logits: Tensor, box_codes: Tensor, truth: DetectionTargets, config: DetectionLossConfig
) -> Tensor:
    """(Q, G) focal cost plus L1 distance of the box codes without velocity.

    Args:
        class_logits: (Q, classes).
        box_codes: (Q, 10).
        truth: G boxes.
    """
    classes = focal_cost(class_logits)[:, truth.labels]
    boxes = torch.cdist(box_codes[:, :VELOCITY_START], truth.codes[:, :VELOCITY_START], p=1)
    return config.class_weight * classes + config.box_weight * boxes


def box_loss(predicted: Tensor, truth: Tensor, config: DetectionLossConfig) -> Tensor:
    """() L1 loss of matched box codes, summed. Boxes of unknown velocity are left out entirely, as published.

    Args:
        predicted: (K, 10).
        truth: (K, 10).
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


def _layer_loss(
    class_logits: Tensor, box_codes: Tensor, targets: Sequence[DetectionTargets], config: DetectionLossConfig
) -> Tensor:
    """(2,) class loss and box loss of one decoder layer."""
    class_targets = torch.zeros_like(class_logits)  # (B, Q, classes)
    predicted, truths = [], []
    for element, truth in enumerate(targets):
        pairs = hungarian_matching(matching_costs(class_logits[element], box_codes[element], truth, config))
        class_targets[element, pairs.queries, truth.labels[pairs.truths]] = 1
        predicted.append(box_codes[element, pairs.queries])
        truths.append(truth.codes[pairs.truths])
    classes = config.class_weight * focal_loss(class_logits, class_targets).sum()
    boxes = config.box_weight * box_loss(torch.cat(predicted), torch.cat(truths), config)
    return torch.stack([classes, boxes]) / max(sum(map(len, predicted)), 1)
