"""The segmentation loss: focal and dice loss of masks and focal loss of classes after every mask layer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bevcli.model.segmentation import STUFF_CLASSES, SegmentationOutputs
from bevcli.training.dice_loss import dice_costs, dice_loss
from bevcli.training.focal_loss import focal_cost, focal_loss
from bevcli.training.matcher import match
from bevcli.training.segmentation_targets import SegmentationTargets


@dataclass(frozen=True)
class SegmentationLossConfig:
    """class_weight: focal loss of the classes. location_weight: L1 of the things' locations.

    dice_weight, pixel_weight: dice and focal loss of the masks, the latter a mask's mean over cells.
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
    """Weighted, summed over the layers."""

    classes: Tensor
    masks: Tensor
    locations: Tensor

    @property
    def total(self) -> Tensor:
        """Their sum."""
        return self.classes + self.masks + self.locations


@dataclass(frozen=True)
class _Chosen:
    """Of one batch element: queries that show something, (K,); their masks, (K, Y·X); T: the matched things."""

    queries: Tensor
    masks: Tensor
    things: Tensor
    locations: Tensor


def segmentation_loss(
    outputs: SegmentationOutputs, targets: Sequence[SegmentationTargets], config: SegmentationLossConfig
) -> SegmentationLoss:
    """targets: B. Things are matched once, by what the last layers say; every layer answers to that matching.

    The losses of things are divided by the number of things in the batch, those of stuff by the masks of stuff, so
    that many vehicles do not drown the road. A frame without a map trains no stuff query.
    """
    chosen = [_choose(outputs, element, truth, config) for element, truth in enumerate(targets)]
    things = sum(len(one.things) for one in chosen)
    stuff = sum(len(one.queries) for one in chosen) - things
    shares = outputs.class_logits.new_full(outputs.class_logits.shape[-1:], 1 / max(things, 1))  # (Q,)
    shares[: len(STUFF_CLASSES)] = 1 / max(stuff, 1)
    classes = config.class_weight * (_class_losses(outputs.class_logits, chosen, targets) * shares).sum()
    masks, locations = classes.new_zeros(()), classes.new_zeros(())
    for element, one in enumerate(chosen):
        losses = _mask_losses(outputs.mask_logits[:, element, one.queries], one.masks, config)
        masks = masks + (losses * shares[one.queries]).sum()
        errors = outputs.locations[:, element, one.things] - one.locations
        locations = locations + config.location_weight * errors.abs().sum() / max(things, 1)
    return SegmentationLoss(classes, masks, locations)


def matching_costs(
    outputs: SegmentationOutputs, element: int, truth: SegmentationTargets, config: SegmentationLossConfig
) -> Tensor:
    """(T, G): what it costs that a thing query of a batch element answers for a vehicle."""
    first = len(STUFF_CLASSES)
    classes = focal_cost(outputs.class_logits[-1, element, first:])[:, None]
    locations = torch.cdist(outputs.locations[-1, element], truth.locations, p=1)
    dice = dice_costs(outputs.mask_logits[-1, element, first:], truth.things)
    return config.class_weight * classes + config.location_weight * locations + config.dice_weight * dice


def _choose(
    outputs: SegmentationOutputs, element: int, truth: SegmentationTargets, config: SegmentationLossConfig
) -> _Chosen:
    pairs = match(matching_costs(outputs, element, truth, config))
    queries, masks = pairs.queries + len(STUFF_CLASSES), truth.things[pairs.truths]
    if truth.stuff is not None:
        present = truth.stuff.any(-1)
        queries = torch.cat([present.nonzero()[:, 0], queries])
        masks = torch.cat([truth.stuff[present], masks])
    return _Chosen(queries, masks, pairs.queries, truth.locations[pairs.truths])


def _class_losses(class_logits: Tensor, chosen: Sequence[_Chosen], targets: Sequence[SegmentationTargets]) -> Tensor:
    """Focal losses (M, B, Q) of class_logits (M, B, Q)."""
    wanted, taught = torch.zeros_like(class_logits), torch.ones_like(class_logits)
    for element, (one, truth) in enumerate(zip(chosen, targets, strict=True)):
        wanted[:, element, one.queries] = 1
        if truth.stuff is None:
            taught[:, element, : len(STUFF_CLASSES)] = 0
    return focal_loss(class_logits, wanted) * taught


def _mask_losses(logits: Tensor, masks: Tensor, config: SegmentationLossConfig) -> Tensor:
    """logits: (M, K, Y·X) against masks (K, Y·X) -> (M, K)."""
    masks = masks.expand_as(logits)
    return config.dice_weight * dice_loss(logits, masks) + config.pixel_weight * focal_loss(logits, masks).mean(-1)
