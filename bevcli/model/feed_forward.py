"""The feed-forward network of a transformer layer."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn


class FeedForward(nn.Module):
    """Linear, ReLU, linear, with dropout after each linear layer."""

    def __init__(self, channels: int, width: int, dropout: float) -> None:
        super().__init__()
        self.expand = nn.Linear(channels, width)
        self.reduce = nn.Linear(width, channels)
        self.dropout = nn.Dropout(dropout)
        for layer in (self.expand, self.reduce):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor) -> Tensor:
        """x: (..., C) -> (..., C), without the residual."""
        return self.dropout(self.reduce(self.dropout(F.relu(self.expand(x), inplace=True))))
