"""Focal loss and one-to-one matching, of which the losses of all heads that find things are made."""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from bevcli.model.upload import upload

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
    queries, truths = (
        torch.as_tensor(indices, device=costs.device) for indices in linear_sum_assignment(_finite(costs))
    )
    return queries, truths


def hungarian_matchings(costs: Tensor, counts: Sequence[int]) -> tuple[Tensor, Tensor]:
    """The assignments of many matrices at once, with one copy to the CPU and one back.

    Args:
        costs: (..., B, Q, G) of each query and ground truth.
        counts: B numbers of ground truths; the others, up to G, are padding.

    Returns (..., B, Q) int64, the ground truth of each query, and (..., B, G) int64, the query of each ground truth;
    -1 for none.
    """
    *leading, queries, truths = costs.shape
    matrices = _finite(costs).reshape(-1, queries, truths)
    pairs = torch.full((len(matrices), queries + truths), -1)
    numbers = pairs.numpy()
    for index, matrix in enumerate(matrices):
        of_queries, of_truths = linear_sum_assignment(matrix[:, : counts[index % len(counts)]])
        numbers[index, of_queries] = of_truths
        numbers[index, queries + of_truths] = of_queries
    truth_of_query, query_of_truth = upload(pairs, costs.device).split([queries, truths], dim=1)
    return truth_of_query.view(*leading, queries), query_of_truth.view(*leading, truths)


def _finite(costs: Tensor) -> NDArray[np.float64]:
    finite = costs.detach().cpu().double()
    return np.asarray(finite.nan_to_num(UNUSABLE_COST, UNUSABLE_COST, -UNUSABLE_COST).numpy())
