"""The losses of the model's heads: boxes, masks, and, in training only, boxes of BEV cells.

The detection loss as published: Hungarian matching, then focal and L1 loss after each decoder layer. The segmentation
loss: focal, dice and L1 loss after each mask layer. All heads that find things share the focal loss and the matching.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from scipy.optimize import linear_sum_assignment
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.decoder import BOX_CODE_SIZE
from bevcli.model.segmentation import STUFF_CLASSES, SegmentationOutputs
from bevcli.model.upload import upload
from bevcli.parsing.documents import NotNegative, Positive
from bevcli.workshop.training.targets import PaddedMasks, PaddedTargets

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


def hungarian_matchings(costs: Tensor, counts: Sequence[int]) -> tuple[Tensor, Tensor]:
    """The one-to-one assignments with the smallest sums of costs. Many matrices take one copy to the CPU and one back.

    Args:
        costs: (..., B, Q, G) of each query and ground truth.
        counts: B numbers of ground truths; the others, up to G, are padding.

    Returns (..., B, Q) int64, the ground truth of each query, and (..., B, G) int64, the query of each ground truth;
    -1 for none.
    """
    *leading, queries, truths = costs.shape
    finite = costs.detach().cpu().double().nan_to_num(UNUSABLE_COST, UNUSABLE_COST, -UNUSABLE_COST)
    matrices = finite.numpy().reshape(-1, queries, truths)
    pairs = torch.full((len(matrices), queries + truths), -1)
    numbers = pairs.numpy()
    for index, matrix in enumerate(matrices):
        of_queries, of_truths = linear_sum_assignment(matrix[:, : counts[index % len(counts)]])
        numbers[index, of_queries] = of_truths
        numbers[index, queries + of_truths] = of_queries
    truth_of_query, query_of_truth = upload(pairs, costs.device).split([queries, truths], dim=1)
    return truth_of_query.view(*leading, queries), query_of_truth.view(*leading, truths)


VELOCITY_START = 8  # entries 8 and 9 of a box code are vx and vy
MIN_MOVING_MPS = 0.5  # slower objects count as stationary


@dataclass(frozen=True)
class DetectionLossConfig:
    """Weights of the detection loss. The class and box weights apply to the matching costs too."""

    class_weight: NotNegative = 2.0  # of the focal loss of the classes
    box_weight: NotNegative = 0.25  # of the L1 loss of the box codes
    velocity_weight: NotNegative = 0.2  # of vx and vy within the L1 loss
    # additional factor for moving objects: else zero everywhere may be the smallest loss
    moving_weight: NotNegative = 1.0
    # above 0, class targets are exp(-d / quality_m), d metres between the centres, instead of 1
    quality_m: NotNegative = 0.0


def detection_loss(
    class_logits: Tensor, box_codes: Tensor, truth: PaddedTargets, config: DetectionLossConfig, groups: int = 1
) -> dict[str, Tensor]:
    """The weighted losses of classes and boxes, summed over L decoder layers.

    Each layer is matched anew; losses are divided by the matched boxes of the batch.

    Args:
        class_logits: (L, B, groups · Q, classes).
        box_codes: (L, B, groups · Q, 10).
        truth: of B frames.
        groups: number of query groups, stored one after another. Each is matched on its own (Group DETR); the
            loss is the mean over the groups.
    """
    # (L, B, groups · Q, ...) -> (L · groups, B, Q, ...)
    logits, codes = (x.unflatten(2, (groups, -1)).movedim(2, 1).flatten(0, 1) for x in (class_logits, box_codes))
    with torch.no_grad():  # (..., B, Q, G) focal cost plus L1 distance of the box codes without velocity
        labels = truth.labels[:, None].expand(*logits.shape[:-1], -1)
        distances = torch.cdist(codes[..., :VELOCITY_START], truth.codes[..., :VELOCITY_START], p=1)
        costs = config.class_weight * focal_cost(logits).gather(-1, labels) + config.box_weight * distances
    objects, _ = hungarian_matchings(costs, truth.counts)
    classes, boxes = assigned_loss(logits, codes, truth, objects, config).sum(0) / groups
    return {"classes": classes, "boxes": boxes}


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
    assigned, object_index = objects >= 0, objects.clamp(min=0)
    leading = objects.shape[:-2]
    labels = truth.labels.expand(*leading, -1, -1).gather(-1, object_index)  # (..., B, Q)
    index = object_index[..., None].expand(*object_index.shape, box_codes.shape[-1])
    codes = truth.codes.expand(*leading, -1, -1, -1).gather(-2, index)  # (..., B, Q, 10)
    qualities = box_codes.new_ones(box_codes.shape[:-1])
    if config.quality_m:
        qualities = torch.exp((codes[..., :2] - box_codes[..., :2].detach()).norm(dim=-1) / -config.quality_m)
    class_targets = torch.zeros_like(class_logits).scatter_(-1, labels[..., None], (qualities * assigned)[..., None])
    classes = config.class_weight * focal_loss(class_logits, class_targets).sum((-3, -2, -1))
    boxes = config.box_weight * box_losses(box_codes, codes, assigned, config).sum((-2, -1))
    return torch.stack([classes, boxes], -1) / assigned.sum((-2, -1)).clamp(min=1)[..., None]


def box_losses(predicted: Tensor, truth: Tensor, assigned: Tensor, config: DetectionLossConfig) -> Tensor:
    """(...) L1 losses of box codes, 0 where `assigned` (...) is false, or the true velocity is not known.

    predicted and truth: (..., 10).
    """
    is_compared = (assigned & truth.isfinite().all(-1))[..., None]
    predicted, truth = predicted.where(is_compared, 0), truth.where(is_compared, 0)
    errors = F.l1_loss(predicted, truth, reduction="none")  # (..., 10)
    moving = truth[..., VELOCITY_START:].norm(dim=-1) >= MIN_MOVING_MPS
    weights = config.velocity_weight * torch.where(moving, config.moving_weight, 1.0)
    return errors[..., :VELOCITY_START].sum(-1) + weights * errors[..., VELOCITY_START:].sum(-1)


@dataclass(frozen=True)
class DenseLossConfig:
    """The [training.dense_loss] table."""

    weight: NotNegative = 0.0  # of the whole loss; 0 disables it, as published
    reach_m: Positive = 1.5  # cells up to this distance from an object's centre are positives, metres


class DenseHead(nn.Module):
    """One linear layer that predicts classes and a box from each BEV cell."""

    centers: Tensor

    def __init__(self, channels: int, classes: int, grid: BevGrid) -> None:
        super().__init__()
        self.classes = nn.Linear(channels, classes)
        self.boxes = nn.Linear(channels, BOX_CODE_SIZE)
        nn.init.constant_(self.classes.bias, -math.log(99))  # focal prior, as in the detection head
        centers = torch.as_tensor(grid.cell_centers(), dtype=torch.float32).reshape(-1, 2)
        self.register_buffer("centers", centers, persistent=False)

    def forward(self, bev: Tensor) -> tuple[Tensor, Tensor]:
        """bev: (B, Y·X, C) -> class logits (B, Y·X, classes) and box codes (B, Y·X, 10).

        The layer predicts a box centre as an offset from the cell's centre, metres.
        """
        codes = self.boxes(bev)
        return self.classes(bev), torch.cat([codes[..., :2] + self.centers, codes[..., 2:]], dim=-1)


def dense_loss(
    head: DenseHead, bev: Tensor, truth: PaddedTargets, config: DenseLossConfig, detection: DetectionLossConfig
) -> dict[str, Tensor]:
    """Focal loss of all cells and L1 loss of the positive ones, divided by the number of positive cells.

    bev: (B, Y·X, C). truth: of B frames. detection: the weights of classes and boxes, as in the detection loss.
    """
    logits, codes = head(bev)
    # The nearest object of each cell. Not by a product of matrices, which a GPU may round.
    distances = torch.cdist(head.centers, truth.codes[..., :2], compute_mode="donot_use_mm_for_euclid_dist")
    distance, nearest = distances.where(truth.exists[:, None], torch.inf).min(dim=-1)  # (B, Y·X)
    objects = nearest.where(distance <= config.reach_m, -1)
    classes, boxes = config.weight * assigned_loss(logits, codes, truth, objects, detection)
    return {"cell classes": classes, "cell boxes": boxes}


DICE_SMOOTHING = 1e-3


@dataclass(frozen=True)
class SegmentationLossConfig:
    """The [training.segmentation_loss] table."""

    class_weight: NotNegative = 1.0  # of the focal loss of the classes
    location_weight: NotNegative = 2.0  # of the L1 loss of the things' locations
    dice_weight: NotNegative = 1.0  # of the dice loss of the masks
    pixel_weight: NotNegative = 10.0  # of the focal loss of the masks, averaged over the cells of a mask


def segmentation_loss(
    outputs: SegmentationOutputs, truth: PaddedMasks, config: SegmentationLossConfig
) -> dict[str, Tensor]:
    """The weighted losses of all layers for B frames. Things are matched once, by the outputs of the last layer.

    The losses of things are divided by the number of things in the batch, those of stuff by the number of stuff masks,
    so that many vehicles do not outweigh the road. A frame without a map trains no stuff query.
    """
    first = len(STUFF_CLASSES)
    with torch.no_grad():  # (B, T, G) of each thing query and each vehicle, by the last layer
        costs = config.class_weight * focal_cost(outputs.class_logits[-1, :, first:])[..., None]
        costs = costs + config.location_weight * torch.cdist(outputs.locations[-1], truth.locations, p=1)
        costs = costs + config.dice_weight * dice_costs(outputs.mask_logits[-1, :, first:], truth.things)
    _, queries = hungarian_matchings(costs, truth.counts)  # (B, G)
    assigned = torch.cat([truth.stuff.any(-1), queries >= 0], 1).float()  # (B, S + G)
    queries = queries.clamp(min=0) + first
    stuff, things = assigned[:, :first].sum().clamp(min=1), assigned[:, first:].sum().clamp(min=1)
    layers = outputs.class_logits.shape[0]

    class_targets = torch.zeros_like(outputs.class_logits)  # (M, B, Q)
    class_targets[..., :first] = assigned[:, :first]
    of_things = assigned[:, first:]
    class_targets.scatter_add_(-1, *(x.expand(layers, -1, -1) for x in (queries, of_things)))
    class_losses = focal_loss(outputs.class_logits, class_targets)
    of_stuff = class_losses[..., :first] * truth.has_stuff
    classes = of_stuff.sum() / stuff + class_losses[..., first:].sum() / things

    logits = _of_queries(outputs.mask_logits, queries)  # (M, B, G, Y·X)
    logits = torch.cat([outputs.mask_logits[:, :, :first], logits], 2)
    masks = torch.cat([truth.stuff, truth.things], 1).expand_as(logits)
    losses = config.dice_weight * dice_loss(logits, masks)
    losses = (losses + config.pixel_weight * focal_loss(logits, masks).mean(-1)) * assigned
    errors = (_of_queries(outputs.locations, queries - first) - truth.locations).abs().sum(-1) * of_things
    return {
        "map classes": config.class_weight * classes,
        "masks": losses[..., :first].sum() / stuff + losses[..., first:].sum() / things,
        "locations": config.location_weight * errors.sum() / things,
    }


def _of_queries(tensor: Tensor, queries: Tensor) -> Tensor:
    """(M, B, Q, ...) -> (M, B, G, ...), those of the queries (B, G)."""
    index = queries[None, ..., None].expand(len(tensor), -1, -1, tensor.shape[-1])
    return tensor.gather(2, index)


def dice_loss(logits: Tensor, targets: Tensor) -> Tensor:
    """(...) dice loss with squared sums (V-Net), about 0 for equal masks and 1 for disjoint ones.

    logits: (..., cells). targets: (..., cells), 0 or 1.
    """
    masks = logits.sigmoid()
    return _dice((masks * targets).sum(-1), masks.square().sum(-1) + targets.square().sum(-1))


def dice_costs(logits: Tensor, targets: Tensor) -> Tensor:
    """(..., Q, G) dice loss of each predicted mask against each target mask.

    logits: (..., Q, cells). targets: (..., G, cells), 0 or 1.
    """
    masks = logits.sigmoid()
    sums = masks.square().sum(-1)[..., None] + targets.square().sum(-1)[..., None, :]
    return _dice(masks @ targets.mT, sums)


def _dice(overlap: Tensor, sums: Tensor) -> Tensor:
    return 1 - (2 * overlap + DICE_SMOOTHING) / (sums + DICE_SMOOTHING)
