"""The perspective head of BEVFormerV2 (Yang et al. 2023): detects 3D boxes in each camera image alone.

It is a convolutional detector on the image features, as in FCOS3D: every pixel of every level predicts classes and a
box. Its loss trains the image backbone directly. It exists in training only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from bevcli.training.perspective_targets import BOX_NUMBERS


class PerspectiveHead(nn.Module):
    """One branch for the classes and one for the boxes, shared by all levels."""

    def __init__(self, channels: int, classes: int, layers: int) -> None:
        super().__init__()
        self.class_branch = _branch(channels, classes, layers)
        self.box_branch = _branch(channels, BOX_NUMBERS, layers)
        nn.init.constant_(self.class_branch[-1].bias, -math.log(99))  # type: ignore[arg-type]  # focal prior

    def forward(self, feature_maps: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Classes and boxes at the S locations of P images, level by level from fine to coarse, row by row.

        Args:
            feature_maps: (P, C, H_l, W_l) of each level.

        Returns:
            Class logits (P, S, classes) and box numbers (P, S, 8), as `PerspectiveTargets` describes them.
        """
        logits, boxes = (
            torch.cat([branch(features).flatten(2).movedim(1, -1) for features in feature_maps], 1)
            for branch in (self.class_branch, self.box_branch)
        )
        return logits, boxes


def _branch(channels: int, outputs: int, layers: int) -> nn.Sequential:
    """`layers` convolutions with group norm, and one that predicts. A group has about 8 channels, as in FCOS3D."""
    groups = math.gcd(channels, max(1, channels // 8))
    modules: list[nn.Module] = []
    for _ in range(layers):
        convolution = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        modules += [convolution, nn.GroupNorm(groups, channels), nn.ReLU()]
    prediction = nn.Conv2d(channels, outputs, 3, padding=1)
    nn.init.normal_(prediction.weight, std=0.01)
    nn.init.zeros_(prediction.bias)  # type: ignore[arg-type]
    return nn.Sequential(*modules, prediction)
