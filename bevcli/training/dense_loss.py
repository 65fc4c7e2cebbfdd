"""A dense loss beside those of the heads: every BEV cell near an object says its class and its box itself.

The heads teach the BEV map through the few queries that are matched; here every object teaches the cells where it
stands, which makes a short training learn much sooner. The layer that reads the cells serves training only.
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
    """weight: of the whole loss; 0 leaves it out, as published. reach_m: how far from its centre an object teaches."""

    weight: float = 0.0
    reach_m: float = 1.5

    def __post_init__(self) -> None:
        if self.weight < 0 or self.reach_m <= 0:
            raise ValueError("weight must not be negative, reach_m must be positive")


class DenseReader(nn.Module):
    """(B, Y·X, C) BEV map -> class logits (B, Y·X, classes) and box codes (B, Y·X, 10), by one linear layer.

    A code's centre is that of the cell moved by what the layer says, in metres.
    """

    centers: Tensor

    def __init__(self, channels: int, classes: int, grid: BevGrid) -> None:
        super().__init__()
        self.classes = nn.Linear(channels, classes)
        self.boxes = nn.Linear(channels, BOX_CODE_SIZE)
        nn.init.constant_(self.classes.bias, -math.log(99))  # focal prior, as in the detection head
        centers = torch.as_tensor(grid.cell_centers(), dtype=torch.float32).reshape(-1, 2)
        self.register_buffer("centers", centers, persistent=False)

    def forward(self, bev: Tensor) -> tuple[Tensor, Tensor]:
        """bev: (B, Y·X, C)."""
        codes = self.boxes(bev)
        return self.classes(bev), torch.cat([codes[..., :2] + self.centers, codes[..., 2:]], dim=-1)


def dense_loss(
    reader: DenseReader,
    bev: Tensor,
    targets: Sequence[DetectionTargets],
    config: DenseLossConfig,
    of_boxes: DetectionLossConfig,
) -> DetectionLoss:
    """bev: (B, Y·X, C). targets: B. Focal and L1 loss as of the detection head, over the number of taught cells."""
    logits, codes = reader(bev)
    wanted = torch.zeros_like(logits)
    found, truths = [], []
    for element, truth in enumerate(targets):
        cells, owners = _taught_cells(reader.centers, truth.codes[:, :2], config.reach_m)
        wanted[element, cells, truth.labels[owners]] = 1
        found.append(codes[element, cells])
        truths.append(truth.codes[owners])
    count = max(sum(map(len, found)), 1)
    classes = of_boxes.class_weight * focal_loss(logits, wanted).sum() / count
    boxes = of_boxes.box_weight * box_loss(torch.cat(found), torch.cat(truths), of_boxes) / count
    return DetectionLoss(config.weight * classes, config.weight * boxes)


def _taught_cells(cells: Tensor, objects: Tensor, reach_m: float) -> tuple[Tensor, Tensor]:
    """The cells with an object in reach, (K,), and the nearest one of theirs, (K,); cells (S, 2), objects (G, 2)."""
    if not len(objects):
        return (torch.zeros(0, dtype=torch.int64, device=cells.device),) * 2
    distance, nearest = torch.cdist(cells, objects).min(dim=1)
    taught = (distance <= reach_m).nonzero()[:, 0]
    return taught, nearest[taught]
