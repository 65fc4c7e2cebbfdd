"""Focal loss and one-to-one matching, of which the losses of all heads that find things are made."""

import torch
import torch.nn.functional as F
from scipy.optimize import linear_sum_assignment
from torch import Tensor

ALPHA, GAMMA = 0.25, 2.0  # of the focal loss (Lin et al. 2017)
UNUSABLE_COST = 1e5  # replaces a cost that is not finite, so that such a pair is chosen last


def focal_loss(logits: Tensor, targets: Tensor) -> Tensor:
    """Elementwise focal loss, not reduced. Positives (targets above 0) have weight ALPHA, negatives 1 - ALPHA.

    It is smallest where the probability is the target. Between 0 and 1 it is the quality focal loss (Li et al. 2020).
    logits: any shape. targets: the same shape, 0 to 1.
    """
    distance = (targets - logits.sigmoid()).abs()
    weight = torch.where(targets > 0, ALPHA, 1 - ALPHA)
    return weight * distance**GAMMA * F.binary_cross_entropy_with_logits(logits, targets, reduction="none")


def focal_cost(logits: Tensor) -> Tensor:
    """Focal loss as a positive minus focal loss as a negative; elementwise, negative for confident positives."""
    probability = logits.sigmoid()
    positive = -F.logsigmoid(logits) * ALPHA * (1 - probability) ** GAMMA
    negative = -F.logsigmoid(-logits) * (1 - ALPHA) * probability**GAMMA
    return positive - negative


def hungarian_matching(costs: Tensor) -> tuple[Tensor, Tensor]:
    """The one-to-one assignment with the smallest sum of costs: (K,) int64 query and (K,) ground truth indices.

    costs: (Q, G) of each query and ground truth. The K = min(Q, G) pairs are on their device, sorted by query.
    """
    finite = costs.detach().double().cpu().nan_to_num(UNUSABLE_COST, UNUSABLE_COST, -UNUSABLE_COST)
    queries, truths = (torch.as_tensor(indices, device=costs.device) for indices in linear_sum_assignment(finite))
    return queries, truths
