"""The dice loss of masks: one minus twice the overlap over the sum of both, squared sums as in V-Net."""

from __future__ import annotations

from torch import Tensor

SMOOTHING = 1e-3


def dice_loss(logits: Tensor, targets: Tensor) -> Tensor:
    """Masks (..., cells), logits against 0 or 1 -> (...), 0 for equal masks, 1 for masks apart."""
    masks = logits.sigmoid()
    overlap = (masks * targets).sum(-1)
    return 1 - (2 * overlap + SMOOTHING) / (masks.square().sum(-1) + targets.square().sum(-1) + SMOOTHING)


def dice_costs(logits: Tensor, targets: Tensor) -> Tensor:
    """The loss of each of Q masks (Q, cells) against each of G (G, cells) -> (Q, G)."""
    masks = logits.sigmoid()
    overlap = masks @ targets.T
    sums = masks.square().sum(-1)[:, None] + targets.square().sum(-1)
    return 1 - (2 * overlap + SMOOTHING) / (sums + SMOOTHING)
