"""The sigmoid focal loss (Lin et al. 2017), and the matching cost derived from it."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

ALPHA, GAMMA = 0.25, 2.0


def focal_loss(logits: Tensor, targets: Tensor) -> Tensor:
    """Elementwise focal loss, not reduced. Positives have weight ALPHA, negatives 1 - ALPHA.

    Args:
        logits: any shape.
        targets: the same shape, 0 or 1.
    """
    probability = logits.sigmoid()
    probability_of_target = probability * targets + (1 - probability) * (1 - targets)
    weight = ALPHA * targets + (1 - ALPHA) * (1 - targets)
    cross_entropy = F.binary_cross_entropy_with_logits(logits, targets, reduction="none")
    return weight * (1 - probability_of_target) ** GAMMA * cross_entropy


def focal_cost(logits: Tensor) -> Tensor:
    """Focal loss as a positive minus focal loss as a negative; elementwise, negative for confident positives."""
    probability = logits.sigmoid()
    positive = -F.logsigmoid(logits) * ALPHA * (1 - probability) ** GAMMA
    negative = -F.logsigmoid(-logits) * (1 - ALPHA) * probability**GAMMA
    return positive - negative
