"""The feed-forward network of a transformer layer."""

from typing import Literal

import torch.nn.functional as F
from torch import Tensor, nn


class FeedForward(nn.Module):
    """Linear, activation, linear, with dropout after each linear layer."""

    def __init__(self, channels: int, width: int, dropout: float, activation: Literal["relu", "gelu"] = "relu") -> None:
        super().__init__()
        self.activation = activation
        self.expand = nn.Linear(channels, width)
        self.reduce = nn.Linear(width, channels)
        self.dropout = nn.Dropout(dropout)
        for layer in (self.expand, self.reduce):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor) -> Tensor:
        """x: (..., C) -> (..., C), without the residual."""
        expanded = self.expand(x)
        activated = F.gelu(expanded) if self.activation == "gelu" else F.relu(expanded, inplace=True)
        return self.dropout(self.reduce(self.dropout(activated)))
