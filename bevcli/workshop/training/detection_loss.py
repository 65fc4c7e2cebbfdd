"""The detection loss: targets, Hungarian matching, then focal and L1 loss after each decoder layer, as published.

The losses of all heads that find things share its focal loss and its one-to-one matching.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from bevcli.geometry.boxes import Boxes3D
from bevcli.model.config import ModelConfig
from bevcli.model.decoder import encode
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


VELOCITY_START = 8  # entries 8 and 9 of a box code are vx and vy
MIN_MOVING_MPS = 0.5  # slower objects count as stationary


@dataclass(frozen=True)
class DetectionTargets:
    """The G ground truth boxes of one frame.

    Attributes:
        labels: (G,) int64, indices into the model's classes.
        codes: (G, 10) float32 box codes (see `bevcli.model.decoder`); unknown velocities are NaN.
    """

    labels: Tensor
    codes: Tensor


@dataclass(frozen=True)
class PaddedTargets:
    """The ground truth boxes of B frames, padded to the G boxes of the frame with the most, at least 1.

    Attributes:
        labels: (B, G) int64, indices into the model's classes; 0 for padding.
        codes: (B, G, 10) float32 box codes; 0 for padding.
        exists: (B, G) bool, false for padding.
        counts: B numbers of boxes.
    """

    labels: Tensor
    codes: Tensor
    exists: Tensor
    counts: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.counts)

    def __getitem__(self, frame: int) -> DetectionTargets:
        """The boxes of one frame."""
        count = self.counts[frame]
        return DetectionTargets(self.labels[frame, :count], self.codes[frame, :count])


AnyTargets = Sequence[DetectionTargets] | PaddedTargets  # of B frames


def padded(targets: AnyTargets) -> PaddedTargets:
    """The boxes of B frames as tensors."""
    if isinstance(targets, PaddedTargets):
        return targets
    counts = tuple(len(one.labels) for one in targets)
    labels, codes = (pad_rows([getattr(one, name) for one in targets]) for name in ("labels", "codes"))
    exists = pad_rows([torch.ones_like(one.labels, dtype=torch.bool) for one in targets])
    return PaddedTargets(labels, codes, exists, counts)


def pad_rows(tensors: Sequence[Tensor]) -> Tensor:
    """(B, G, ...) of B tensors (G_i, ...), padded with zeros to the largest of G_i, at least 1."""
    rows = max(1, *map(len, tensors))
    out = tensors[0].new_zeros(len(tensors), rows, *tensors[0].shape[1:])
    for padded_rows, tensor in zip(out, tensors, strict=True):
        padded_rows[: len(tensor)] = tensor
    return out


def detection_targets(boxes: Boxes3D, config: ModelConfig) -> DetectionTargets:
    """The `box_targets` of the boxes (ground truth, bev frame) with a centre inside the BEV grid."""
    return box_targets(boxes_inside(boxes, config), config.classes)


def boxes_inside(boxes: Boxes3D, config: ModelConfig) -> Boxes3D:
    """The boxes (ground truth, bev frame) that are `detection_targets`, in their order."""
    grid = config.bev_grid
    low, high = np.array([grid.x_range_m, grid.y_range_m, grid.z_range_m]).T
    return _learned(boxes[((boxes.centers >= low) & (boxes.centers <= high)).all(-1)], config.classes)


def box_targets(boxes: Boxes3D, classes: tuple[str, ...]) -> DetectionTargets:
    """Targets from all boxes (ground truth, bev frame) that have one of the classes and visible points."""
    kept = _learned(boxes, classes)
    labels = [classes.index(name) for name in kept.classes]
    return DetectionTargets(torch.tensor(labels, dtype=torch.int64), torch.from_numpy(encode(kept)).float())


def _learned(boxes: Boxes3D, classes: tuple[str, ...]) -> Boxes3D:
    return boxes[np.isin(boxes.classes, classes) & has_points(boxes)]


def has_points(boxes: Boxes3D) -> NDArray[np.bool_]:
    """(N,) bool, false where the ground truth counts 0 points; boxes without a count are kept."""
    return np.ones(len(boxes), dtype=bool) if boxes.num_points is None else boxes.num_points != 0


@dataclass(frozen=True)
class DetectionLossConfig:
    """Weights of the detection loss. The class and box weights apply to the matching costs too.

    Attributes:
        class_weight: of the focal loss of the classes.
        box_weight: of the L1 loss of the box codes.
        velocity_weight: of vx and vy within the L1 loss.
        moving_weight: additional factor on the velocity of moving objects (0.5 m/s or faster). If most objects are
            stationary, L1 alone is smallest for a model that predicts zero velocity everywhere.
        quality_m: with a positive value, the class target of a query with an object is exp(-d / quality_m) instead of
            1, d metres from the predicted to the true centre on the ground, so that scores rank boxes by their place.
    """

    class_weight: float = 2.0
    box_weight: float = 0.25
    velocity_weight: float = 0.2
    moving_weight: float = 1.0
    quality_m: float = 0.0

    def __post_init__(self) -> None:
        if min(vars(self).values()) < 0:
            raise ValueError("the weights and quality_m must not be negative")


def detection_loss(
    class_logits: Tensor, box_codes: Tensor, targets: AnyTargets, config: DetectionLossConfig, groups: int = 1
) -> dict[str, Tensor]:
    """The weighted losses of classes and boxes, summed over L decoder layers.

    Each layer is matched anew; losses are divided by the matched boxes of the batch.

    Args:
        class_logits: (L, B, groups · Q, classes).
        box_codes: (L, B, groups · Q, 10).
        targets: B.
        groups: number of query groups, stored one after another. Each is matched on its own (Group DETR); the
            loss is the mean over the groups.
    """
    truth = padded(targets)
    logits, codes = (_groups_as_layers(tensor, groups) for tensor in (class_logits, box_codes))
    objects, _ = hungarian_matchings(matching_costs(logits, codes, truth, config), truth.counts)
    classes, boxes = assigned_loss(logits, codes, truth, objects, config).sum(0) / groups
    return {"classes": classes, "boxes": boxes}


def layer_matches(
    class_logits: Tensor, box_codes: Tensor, targets: AnyTargets, config: DetectionLossConfig
) -> list[tuple[Tensor, Tensor]]:
    """The queries of each of B frames that a layer matches to boxes, and the indices of these, both (K,) int64.

    class_logits: (B, Q, classes). box_codes: (B, Q, 10).
    """
    truth = padded(targets)
    costs = matching_costs(class_logits, box_codes, truth, config)
    return [hungarian_matching(of_frame[:, :count]) for of_frame, count in zip(costs, truth.counts, strict=True)]


def matching_costs(
    class_logits: Tensor, box_codes: Tensor, truth: PaddedTargets, config: DetectionLossConfig
) -> Tensor:
    """(..., B, Q, G) focal cost plus L1 distance of the box codes without velocity. No gradient.

    class_logits: (..., B, Q, classes). box_codes: (..., B, Q, 10). truth: of B frames.
    """
    with torch.no_grad():
        labels = truth.labels[:, None].expand(*class_logits.shape[:-1], -1)
        classes = focal_cost(class_logits).gather(-1, labels)
        boxes = torch.cdist(box_codes[..., :VELOCITY_START], truth.codes[..., :VELOCITY_START], p=1)
        return config.class_weight * classes + config.box_weight * boxes


def _groups_as_layers(tensor: Tensor, groups: int) -> Tensor:
    """(L, B, groups · Q, ...) -> (L · groups, B, Q, ...)."""
    return tensor.unflatten(2, (groups, -1)).movedim(2, 1).flatten(0, 1)


def assigned_loss(
    class_logits: Tensor, box_codes: Tensor, truth: PaddedTargets, objects: Tensor, config: DetectionLossConfig
) -> Tensor:
    """(..., 2) class loss of all queries and box loss of those with an object, divided by the number of the latter.

    Boxes of unknown velocity have no box loss, as published.

    Args:
        class_logits: (..., B, Q, classes).
        box_codes: (..., B, Q, 10).
        truth: of B frames.
        objects: (..., B, Q) int64, the object of each query, -1 for none.
    """
    assigned, chosen = objects >= 0, objects.clamp(min=0)
    leading = objects.shape[:-2]
    labels = truth.labels.expand(*leading, -1, -1).gather(-1, chosen)  # (..., B, Q)
    index = chosen[..., None].expand(*chosen.shape, box_codes.shape[-1])
    codes = truth.codes.expand(*leading, -1, -1, -1).gather(-2, index)  # (..., B, Q, 10)
    qualities = qualities_of(box_codes, codes, config.quality_m) * assigned
    class_targets = torch.zeros_like(class_logits).scatter_(-1, labels[..., None], qualities[..., None])
    classes = config.class_weight * focal_loss(class_logits, class_targets).sum((-3, -2, -1))
    boxes = config.box_weight * box_losses(box_codes, codes, assigned, config).sum((-2, -1))
    return torch.stack([classes, boxes], -1) / assigned.sum((-2, -1)).clamp(min=1)[..., None]


def qualities_of(predicted: Tensor, truth: Tensor, quality_m: float) -> Tensor:
    """(...) the class targets of box codes (..., 10): see `DetectionLossConfig.quality_m`. No gradient."""
    if not quality_m:
        return predicted.new_ones(predicted.shape[:-1])
    return torch.exp((truth[..., :2] - predicted[..., :2].detach()).norm(dim=-1) / -quality_m)


def box_losses(predicted: Tensor, truth: Tensor, assigned: Tensor, config: DetectionLossConfig) -> Tensor:
    """(...) L1 losses of box codes, 0 where `assigned` (...) is false, or the true velocity is not known.

    predicted and truth: (..., 10).
    """
    known = (assigned & truth.isfinite().all(-1))[..., None]
    predicted, truth = predicted.where(known, 0), truth.where(known, 0)
    errors = F.l1_loss(predicted, truth, reduction="none")  # (..., 10)
    moving = truth[..., VELOCITY_START:].norm(dim=-1) >= MIN_MOVING_MPS
    weights = config.velocity_weight * torch.where(moving, config.moving_weight, 1.0)
    return errors[..., :VELOCITY_START].sum(-1) + weights * errors[..., VELOCITY_START:].sum(-1)
