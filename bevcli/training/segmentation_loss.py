"""The segmentation loss after each mask layer: focal and dice loss of masks, focal loss of classes, L1 of locations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bevcli.model.segmentation import STUFF_CLASSES, SegmentationOutputs
from bevcli.training.focal_loss import focal_cost, focal_loss
from bevcli.training.hungarian_matching import hungarian_matching
from bevcli.training.segmentation_targets import SegmentationTargets

DICE_SMOOTHING = 1e-3


@dataclass(frozen=True)
class SegmentationLossConfig:
    """The [training.segmentation_loss] table.

    Attributes:
        class_weight: of the focal loss of the classes.
        location_weight: of the L1 loss of the things' locations.
        dice_weight: of the dice loss of the masks.
        pixel_weight: of the focal loss of the masks, averaged over the cells of a mask.
    """

    class_weight: float = 1.0
    location_weight: float = 2.0
    dice_weight: float = 1.0
    pixel_weight: float = 10.0

    def __post_init__(self) -> None:
        if min(self.class_weight, self.location_weight, self.dice_weight, self.pixel_weight) < 0:
            raise ValueError("the weights must not be negative")


@dataclass(frozen=True)
class SegmentationLoss:
    """Weighted scalar losses, summed over the layers.

    Attributes:
        classes: () focal loss of the classes.
        masks: () dice and focal loss of the masks.
        locations: () L1 loss of the things' locations.
    """

    classes: Tensor
    masks: Tensor
    locations: Tensor

    @property
    def total(self) -> Tensor:
        """() the sum of all."""
        return self.classes + self.masks + self.locations


@dataclass(frozen=True)
class _Assignment:
    """The K queries of one batch element that have a target mask, T of them things.

    Attributes:
        queries: (K,) indices of the queries, stuff first.
        masks: (K, Y·X) their target masks.
        things: (T,) indices of the matched thing queries, counted from the first thing query.
        locations: (T, 4) their target locations.
    """

    queries: Tensor
    masks: Tensor
    things: Tensor
    locations: Tensor


def segmentation_loss(
    outputs: SegmentationOutputs, targets: Sequence[SegmentationTargets], config: SegmentationLossConfig
) -> SegmentationLoss:
    """The loss of all layers. Things are matched once, by the outputs of the last layer.

    The losses of things are divided by the number of things in the batch, those of stuff by the number of stuff masks,
    so that many vehicles do not outweigh the road. A frame without a map trains no stuff query.

    Args:
        targets: B.
    """
    assignments = [_assign(outputs, element, truth, config) for element, truth in enumerate(targets)]
    things = sum(len(assigned.things) for assigned in assignments)
    stuff = sum(len(assigned.queries) for assigned in assignments) - things
    shares = outputs.class_logits.new_full(outputs.class_logits.shape[-1:], 1 / max(things, 1))  # (Q,)
    shares[: len(STUFF_CLASSES)] = 1 / max(stuff, 1)
    classes = config.class_weight * (_class_losses(outputs.class_logits, assignments, targets) * shares).sum()
    masks, locations = classes.new_zeros(()), classes.new_zeros(())
    for element, assigned in enumerate(assignments):
        losses = _mask_losses(outputs.mask_logits[:, element, assigned.queries], assigned.masks, config)
        masks = masks + (losses * shares[assigned.queries]).sum()
        errors = outputs.locations[:, element, assigned.things] - assigned.locations
        locations = locations + config.location_weight * errors.abs().sum() / max(things, 1)
    return SegmentationLoss(classes, masks, locations)


def matching_costs(
    outputs: SegmentationOutputs, element: int, truth: SegmentationTargets, config: SegmentationLossConfig
) -> Tensor:
    """(T, G) cost of assigning each thing query of a batch element to each vehicle, by the last layer."""
    first = len(STUFF_CLASSES)
    classes = focal_cost(outputs.class_logits[-1, element, first:])[:, None]
    locations = torch.cdist(outputs.locations[-1, element], truth.locations, p=1)
    dice = dice_costs(outputs.mask_logits[-1, element, first:], truth.things)
    return config.class_weight * classes + config.location_weight * locations + config.dice_weight * dice


def dice_loss(logits: Tensor, targets: Tensor) -> Tensor:
    """(...) dice loss with squared sums (V-Net), about 0 for equal masks and 1 for disjoint ones.

    Args:
        logits: (..., cells).
        targets: (..., cells), 0 or 1.
    """
    masks = logits.sigmoid()
    overlap = (masks * targets).sum(-1)
    return 1 - (2 * overlap + DICE_SMOOTHING) / (masks.square().sum(-1) + targets.square().sum(-1) + DICE_SMOOTHING)


def dice_costs(logits: Tensor, targets: Tensor) -> Tensor:
    """(Q, G) dice loss of each predicted mask against each target mask.

    Args:
        logits: (Q, cells).
        targets: (G, cells), 0 or 1.
    """
    masks = logits.sigmoid()
    overlap = masks @ targets.T
    sums = masks.square().sum(-1)[:, None] + targets.square().sum(-1)
    return 1 - (2 * overlap + DICE_SMOOTHING) / (sums + DICE_SMOOTHING)


def _assign(
    outputs: SegmentationOutputs, element: int, truth: SegmentationTargets, config: SegmentationLossConfig
) -> _Assignment:
    pairs = hungarian_matching(matching_costs(outputs, element, truth, config))
    queries, masks = pairs.queries + len(STUFF_CLASSES), truth.things[pairs.truths]
    if truth.stuff is not None:
        present = truth.stuff.any(-1)
        queries = torch.cat([present.nonzero()[:, 0], queries])
        masks = torch.cat([truth.stuff[present], masks])
    return _Assignment(queries, masks, pairs.queries, truth.locations[pairs.truths])


def _class_losses(
    class_logits: Tensor, assignments: Sequence[_Assignment], targets: Sequence[SegmentationTargets]
) -> Tensor:
    """(M, B, Q) focal losses of class_logits (M, B, Q), 0 for the stuff queries of a frame without a map."""
    class_targets, trained = torch.zeros_like(class_logits), torch.ones_like(class_logits)
    for element, (assigned, truth) in enumerate(zip(assignments, targets, strict=True)):
        class_targets[:, element, assigned.queries] = 1
        if truth.stuff is None:
            trained[:, element, : len(STUFF_CLASSES)] = 0
    return focal_loss(class_logits, class_targets) * trained


def _mask_losses(logits: Tensor, masks: Tensor, config: SegmentationLossConfig) -> Tensor:
    """(M, K) losses of mask logits (M, K, Y·X) against target masks (K, Y·X)."""
    masks = masks.expand_as(logits)
    return config.dice_weight * dice_loss(logits, masks) + config.pixel_weight * focal_loss(logits, masks).mean(-1)
