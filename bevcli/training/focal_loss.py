"""The sigmoid focal loss (Lin et al. 2017), and the matching cost that goes with it."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

ALPHA, GAMMA = 0.25, 2.0


def focal_loss(logits: Tensor, targets: Tensor) -> Tensor:
    """Elementwise, of any shape; targets are 0 or 1. Positives weigh ALPHA, negatives 1 - ALPHA."""
    probability = logits.sigmoid()
    of_truth = probability * targets + (1 - probability) * (1 - targets)
    weight = ALPHA * targets + (1 - ALPHA) * (1 - targets)
    entropy = F.binary_cross_entropy_with_logits(logits, targets, reduction="none")
    return weight * (1 - of_truth) ** GAMMA * entropy


def focal_cost(logits: Tensor) -> Tensor:
    """What it costs to call a logit positive rather than negative; elementwise, negative where it is likely."""
    probability = logits.sigmoid()
    positive = -F.logsigmoid(logits) * ALPHA * (1 - probability) ** GAMMA
    negative = -F.logsigmoid(-logits) * (1 - ALPHA) * probability**GAMMA
    return positive - negative
