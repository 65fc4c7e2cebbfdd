"""BEV queries (paper, section 3.2): one learned vector a BEV cell, its position embedding, and the can-bus MLP."""

import torch
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.ego_motion import CAN_BUS_SIZE


class BevQueries(nn.Module):
    """The queries that enter the encoder. Only the can-bus embedding, which is added to all of them, changes."""

    def __init__(self, grid: BevGrid, channels: int, can_bus: bool) -> None:
        super().__init__()
        self.embedding = nn.Parameter(torch.randn(grid.rows * grid.columns, channels))
        self.row_embedding = nn.Parameter(torch.rand(grid.rows, channels // 2))
        self.column_embedding = nn.Parameter(torch.rand(grid.columns, channels // 2))
        self.can_bus_embedding: nn.Sequential | None = None
        if can_bus:
            hidden = nn.Linear(CAN_BUS_SIZE, channels // 2), nn.ReLU()
            output = nn.Linear(channels // 2, channels), nn.ReLU(), nn.LayerNorm(channels)
            self.can_bus_embedding = nn.Sequential(*hidden, *output)
            for layer in (hidden[0], output[0]):
                nn.init.xavier_uniform_(layer.weight)
                nn.init.zeros_(layer.bias)

    def forward(self, can_bus: Tensor) -> Tensor:
        """can_bus: (B, 18) -> BEV queries (B, Y·X, C)."""
        if self.can_bus_embedding is None:
            return self.embedding.expand(len(can_bus), -1, -1)
        return self.embedding + self.can_bus_embedding(can_bus)[:, None]

    def position(self) -> Tensor:
        """The position embedding (Y·X, C) of the cells: first that of the column (x), then that of the row (y)."""
        rows, columns = len(self.row_embedding), len(self.column_embedding)
        x = self.column_embedding.expand(rows, -1, -1)
        y = self.row_embedding[:, None].expand(-1, columns, -1)
        return torch.cat([x, y], dim=-1).flatten(0, 1)
