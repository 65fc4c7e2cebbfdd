"""The loss of futures: the mode that ends nearest to the true place learns the movement, and to be the best."""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from bevcli.geometry.boxes import Boxes3D
from bevcli.model.matching import focal_loss
from bevcli.model.vad.loss_weights import LossWeights
from bevcli.model.vad.motion_head import MotionOutputs


def true_offsets(boxes: Boxes3D, device: torch.device) -> Tensor:
    """(G, T, 2) movement of each box in each step, metres; NaN if unknown. The boxes have one future each."""
    assert boxes.futures is not None
    places = np.concatenate([boxes.centers[:, None, :2], boxes.futures[:, 0, :, 1:]], axis=1)
    return torch.tensor(np.diff(places, axis=1), dtype=torch.float32, device=device)


def motion_losses(
    outputs: MotionOutputs,
    truths: Sequence[Boxes3D],
    matches: Sequence[tuple[Tensor, Tensor]],
    weights: LossWeights,
) -> dict[str, Tensor]:
    """The weighted scalar losses, divided by the number of matched boxes whose next place is known.

    Args:
        truths: B.
        matches: of each frame the queries that are matched to boxes, and the indices of these.
    """
    mode_targets, counted = torch.zeros_like(outputs.mode_logits), torch.ones_like(outputs.mode_logits)
    errors, number = outputs.offsets.new_zeros(()), 0
    for element, (boxes, (queries, objects)) in enumerate(zip(truths, matches, strict=True)):
        true = true_offsets(boxes, outputs.offsets.device)[objects]  # (K, T, 2)
        known = true.isfinite().all(-1)
        counted[element, queries[~known[:, 0]]] = 0
        queries, true, known = queries[known[:, 0]], true[known[:, 0]].nan_to_num(), known[known[:, 0]]
        modes = best_modes(outputs.offsets[element, queries], true, known)
        mode_targets[element, queries, modes] = 1
        found = outputs.offsets[element, queries, modes]
        errors = errors + (F.l1_loss(found, true, reduction="none") * known[..., None]).sum()
        number += len(queries)
    classes = (focal_loss(outputs.mode_logits, mode_targets) * counted).sum()
    return {"futures": weights.future * errors / max(number, 1), "modes": weights.mode * classes / max(number, 1)}


@torch.no_grad()
def best_modes(offsets: Tensor, true: Tensor, known: Tensor) -> Tensor:
    """(K,) the mode that is nearest to the true place in the last known step.

    Args:
        offsets: (K, M, T, 2).
        true: (K, T, 2), zero where unknown.
        known: (K, T) bool, true from the first step to the last known one.
    """
    summed = ((offsets - true[:, None]) * known[:, None, :, None]).sum(2)  # (K, M, 2) error of the last known place
    return summed.norm(dim=-1).argmin(-1)
