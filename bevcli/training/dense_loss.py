"""Auxiliary loss on the BEV map: every BEV cell near an object predicts its class and its box.

The detection head trains the BEV map only through the few matched queries. Here each object trains all cells around
its centre directly, so that a short training converges much sooner. The auxiliary head exists in training only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.decoder import BOX_CODE_SIZE
from bevcli.training.detection_loss import DetectionLoss, DetectionLossConfig, box_loss
from bevcli.training.detection_targets import DetectionTargets
from bevcli.training.focal_loss import focal_loss


@dataclass(frozen=True)
class DenseLossConfig:
    """The [training.dense_loss] table.

    Attributes:
        weight: of the whole loss; 0 disables it, as published.
        reach_m: cells up to this distance from an object's centre are positives, metres.
    """

    weight: float = 0.0
    reach_m: float = 1.5

    def __post_init__(self) -> None:
        if self.weight < 0 or self.reach_m <= 0:
            raise ValueError("weight must not be negative, reach_m must be positive")


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
    head: DenseHead,
    bev: Tensor,
    targets: Sequence[DetectionTargets],
    config: DenseLossConfig,
    detection: DetectionLossConfig,
) -> DetectionLoss:
    """Focal loss of all cells and L1 loss of the positive ones, divided by the number of positive cells.

    Args:
        bev: (B, Y·X, C).
        targets: B.
        detection: the weights of classes and boxes, as in the detection loss.
    """
    logits, codes = head(bev)
    class_targets = torch.zeros_like(logits)
    predicted, truths = [], []
    for element, truth in enumerate(targets):
        cells, objects = _positive_cells(head.centers, truth.codes[:, :2], config.reach_m)
        class_targets[element, cells, truth.labels[objects]] = 1
        predicted.append(codes[element, cells])
        truths.append(truth.codes[objects])
    count = max(sum(map(len, predicted)), 1)
    classes = detection.class_weight * focal_loss(logits, class_targets).sum() / count
    boxes = detection.box_weight * box_loss(torch.cat(predicted), torch.cat(truths), detection) / count
    return DetectionLoss(config.weight * classes, config.weight * boxes)


def _positive_cells(cells: Tensor, objects: Tensor, reach_m: float) -> tuple[Tensor, Tensor]:
    """Indices (K,) of the cells within reach of an object, and (K,) of the nearest object of each.

    Args:
        cells: (Y·X, 2) cell centres, metres.
        objects: (G, 2) object centres, metres.
    """
    if not len(objects):
        return (torch.zeros(0, dtype=torch.int64, device=cells.device),) * 2
    distance, nearest = torch.cdist(cells, objects).min(dim=1)
    positive = (distance <= reach_m).nonzero()[:, 0]
    return positive, nearest[positive]
