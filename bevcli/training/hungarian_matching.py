"""One-to-one assignment of queries to ground truth with the smallest total cost (Hungarian algorithm)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

UNUSABLE_COST = 1e5  # replaces a cost that is not finite, so that such a pair is chosen last


@dataclass(frozen=True)
class Matching:
    """K = min(Q, G) pairs of Q queries and G ground truth objects, sorted by query.

    Attributes:
        queries: (K,) int64 query indices.
        truths: (K,) int64 ground truth indices.
    """

    queries: Tensor
    truths: Tensor


def hungarian_matching(costs: Tensor) -> Matching:
    """The one-to-one assignment with the smallest sum of costs.

    Args:
        costs: (Q, G) cost of assigning each query to each ground truth object. The result is on its device.
    """
    finite = np.nan_to_num(
        costs.detach().double().cpu().numpy(), nan=UNUSABLE_COST, posinf=UNUSABLE_COST, neginf=-UNUSABLE_COST
    )
    queries, truths = linear_sum_assignment(finite)
    return Matching(torch.as_tensor(queries, device=costs.device), torch.as_tensor(truths, device=costs.device))
