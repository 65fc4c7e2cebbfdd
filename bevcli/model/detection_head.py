"""The detection head: a class branch and a box branch for each decoder layer, with box refinement."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid

BOX_CODE_SIZE = 10


class DetectionHead(nn.Module):
    """Object queries to class logits and box codes."""

    range_start: Tensor
    range_extent: Tensor

    def __init__(self, layers: int, channels: int, classes: int, grid: BevGrid) -> None:
        super().__init__()
        self.class_branches = nn.ModuleList(_class_branch(channels, classes) for _ in range(layers))
        self.box_branches = nn.ModuleList(_box_branch(channels) for _ in range(layers))
        ranges = torch.tensor([grid.x_range_m, grid.y_range_m, grid.z_range_m])
        self.register_buffer("range_start", ranges[:, 0], persistent=False)
        self.register_buffer("range_extent", ranges[:, 1] - ranges[:, 0], persistent=False)

    def forward(self, layer: int, query: Tensor, reference_points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """query: (B, Q, C) of decoder layer `layer`. reference_points: (B, Q, 3) that entered it, 0 to 1.

        Returns class logits (B, Q, classes), box codes (B, Q, 10) with the centre in metres, and the refined
        reference points (B, Q, 3), which are that centre over the range.
        """
        logits = self.class_branches[layer](query)
        code = self.box_branches[layer](query).float()
        moved = code[..., [0, 1, 4]] + inverse_sigmoid(reference_points)
        refined = moved.sigmoid()
        center = refined * self.range_extent + self.range_start
        box_codes = torch.cat([center[..., :2], code[..., 2:4], center[..., 2:], code[..., 5:]], dim=-1)
        return logits, box_codes, refined


def inverse_sigmoid(x: Tensor) -> Tensor:
    """The logit of x in 0 to 1, finite at both ends."""
    x = x.clamp(0, 1)
    return torch.log(x.clamp(min=1e-5) / (1 - x).clamp(min=1e-5))


def _class_branch(channels: int, classes: int) -> nn.Sequential:
    branch = nn.Sequential(
        nn.Linear(channels, channels),
        nn.LayerNorm(channels),
        nn.ReLU(),
        nn.Linear(channels, channels),
        nn.LayerNorm(channels),
        nn.ReLU(),
        nn.Linear(channels, classes),
    )
    # Focal prior: at the start every class scores 0.01.
    nn.init.constant_(branch[-1].bias, -math.log(99))  # type: ignore[arg-type]
    return branch


def _box_branch(channels: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(channels, channels),
        nn.ReLU(),
        nn.Linear(channels, channels),
        nn.ReLU(),
        nn.Linear(channels, BOX_CODE_SIZE),
    )
