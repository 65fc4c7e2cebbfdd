"""The matcher: which query answers for which ground truth, so that the sum of costs is the least (Hungarian)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

UNUSABLE_COST = 1e5  # what stands for a cost that is not finite: such a pair is chosen last


@dataclass(frozen=True)
class Matching:
    """queries, truths: (K,) int64 each, the K = min(Q, G) pairs, by rising query."""

    queries: Tensor
    truths: Tensor


def match(costs: Tensor) -> Matching:
    """The cheapest one-to-one pairing of Q queries with G ground truths; costs: (Q, G). The pairs are on its device."""
    finite = np.nan_to_num(
        costs.detach().double().cpu().numpy(), nan=UNUSABLE_COST, posinf=UNUSABLE_COST, neginf=-UNUSABLE_COST
    )
    queries, truths = linear_sum_assignment(finite)
    return Matching(torch.as_tensor(queries, device=costs.device), torch.as_tensor(truths, device=costs.device))
