"""The detection loss: matching, focal and L1 loss after every decoder layer, as published."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from bevcli.training.detection_targets import DetectionTargets
from bevcli.training.focal_loss import focal_cost, focal_loss
from bevcli.training.matcher import match

MATCHED_NUMBERS = 8  # of a box code: all but the velocity
MIN_MOVING_SPEED = 0.5  # m/s; what is slower stands


@dataclass(frozen=True)
class DetectionLossConfig:
    """Weights of the class (focal) and box (L1) losses, also in matching. velocity_weight: of vx, vy in L1.

    moving_weight: of what moves, times that. Where most objects stand, L1 is smallest for a model that says 0 of all.
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
    """Weighted, summed over the decoder layers."""

    classes: Tensor
    boxes: Tensor

    @property
    def total(self) -> Tensor:
        """Their sum."""
        return self.classes + self.boxes


def detection_loss(
    class_logits: Tensor,
    box_codes: Tensor,
    targets: Sequence[DetectionTargets],
    config: DetectionLossConfig,
    groups: int = 1,
) -> DetectionLoss:
    """class_logits: (L, B, Q, classes). box_codes: (L, B, Q, 10). targets: B.

    Each layer is matched anew; both losses are divided by the number of matched boxes in the batch.
    groups: of queries, one after another, each matched for itself; the loss is their mean.
    """
    logits, codes = (_groups_as_layers(tensor, groups) for tensor in (class_logits, box_codes))
    layers = [_layer_loss(*layer, targets, config) for layer in zip(logits, codes, strict=True)]
    classes, boxes = torch.stack(layers).sum(0) / groups
    return DetectionLoss(classes, boxes)


def matching_costs(
    class_logits: Tensor, box_codes: Tensor, truth: DetectionTargets, config: DetectionLossConfig
) -> Tensor:
    """class_logits: (Q, classes). box_codes: (Q, 10). Returns (Q, G), focal plus L1 on all but the velocity."""
    classes = focal_cost(class_logits)[:, truth.labels]
    boxes = torch.cdist(box_codes[:, :MATCHED_NUMBERS], truth.codes[:, :MATCHED_NUMBERS], p=1)
    return config.class_weight * classes + config.box_weight * boxes


def _groups_as_layers(tensor: Tensor, groups: int) -> Tensor:
    """(L, B, groups · Q, ...) -> (L · groups, B, Q, ...)."""
    return tensor.unflatten(2, (groups, -1)).movedim(2, 1).flatten(0, 1)


def _layer_loss(
    class_logits: Tensor, box_codes: Tensor, targets: Sequence[DetectionTargets], config: DetectionLossConfig
) -> Tensor:
    """(2,) class and box loss of one decoder layer."""
    wanted = torch.zeros_like(class_logits)  # (B, Q, classes)
    found, truths = [], []
    for element, truth in enumerate(targets):
        pairs = match(matching_costs(class_logits[element], box_codes[element], truth, config))
        wanted[element, pairs.queries, truth.labels[pairs.truths]] = 1
        found.append(box_codes[element, pairs.queries])
        truths.append(truth.codes[pairs.truths])
    boxes = box_loss(torch.cat(found), torch.cat(truths), config)
    count = max(sum(map(len, found)), 1)
    return (
        torch.stack([config.class_weight * focal_loss(class_logits, wanted).sum(), config.box_weight * boxes]) / count
    )


def box_loss(found: Tensor, truth: Tensor, config: DetectionLossConfig) -> Tensor:
    """L1 of matched codes (K, 10), summed; a box of unknown velocity is left out, as published."""
    known = truth.isfinite().all(-1)
    found, truth = found[known], truth[known]
    errors = F.l1_loss(found, truth, reduction="none")  # (K, 10)
    moving = truth[:, MATCHED_NUMBERS:].norm(dim=-1) >= MIN_MOVING_SPEED
    weights = config.velocity_weight * torch.where(moving, config.moving_weight, 1.0)
    return errors[:, :MATCHED_NUMBERS].sum() + (weights * errors[:, MATCHED_NUMBERS:].sum(-1)).sum()
