"""Temporal fusion of BEVFormerV2: the BEV maps of a window of frames become one (paper of V2, section 3.4)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bevcli.model.resnet import BasicBlock


@dataclass(frozen=True)
class BevFusionConfig:
    """The fusion of the window's BEV maps.

    Attributes:
        blocks: number of residual blocks.
        width: channels of the blocks. Where the concatenated maps have another number of channels, the first block's
            shortcut is a convolution.
    """

    blocks: int = 3
    width: int = 512

    def __post_init__(self) -> None:
        if min(self.blocks, self.width) < 1:
            raise ValueError("blocks and width must be positive")


class BevFusion(nn.Module):
    """Maps concatenated along channels, residual blocks, then a linear layer and a layer norm for each cell."""

    def __init__(self, config: BevFusionConfig, frames: int, channels: int, bev_shape: tuple[int, int]) -> None:
        """Random weights. frames: number of BEV maps. bev_shape: their rows and columns."""
        super().__init__()
        self.bev_shape = bev_shape
        inputs = [frames * channels] + (config.blocks - 1) * [config.width]
        self.blocks = nn.Sequential(*(BasicBlock(size, config.width) for size in inputs))
        self.projection = nn.Linear(config.width, channels)
        self.norm = nn.LayerNorm(channels)

    def forward(self, maps: Sequence[Tensor]) -> Tensor:
        """maps: (B, Y·X, C) of each frame, in the order of the window -> the fused map (B, Y·X, C)."""
        cells = torch.cat(list(maps), dim=-1).unflatten(1, self.bev_shape)  # (B, Y, X, frames · C)
        fused = self.blocks(cells.permute(0, 3, 1, 2))  # (B, width, Y, X)
        return self.norm(self.projection(fused.permute(0, 2, 3, 1).flatten(1, 2)))
