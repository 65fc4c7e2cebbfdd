"""The BEV encoder: layers of temporal self-attention, spatial cross-attention and a feed-forward network."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.attention_probe import AttentionProbe
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.feed_forward import FeedForward
from bevcli.model.pillar_projection import PillarHits
from bevcli.model.spatial_cross_attention import SpatialCrossAttention
from bevcli.model.temporal_self_attention import TemporalSelfAttention


@dataclass(frozen=True)
class EncoderConfig:
    """temporal_points: sampling points a head and BEV map.

    spatial_points: sampling points a head and feature level, a multiple of the grid's pillar points.
    """

    layers: int = 6
    attention_heads: int = 8
    temporal_points: int = 4
    spatial_points: int = 8
    feed_forward_width: int = 512
    dropout: float = 0.1

    def __post_init__(self) -> None:
        counts = (self.layers, self.attention_heads, self.temporal_points, self.spatial_points)
        if min(*counts, self.feed_forward_width) < 1 or not 0 <= self.dropout < 1:
            raise ValueError("layers, heads, points and width must be positive, dropout from 0 to below 1")


class Encoder(nn.Module):
    """BEV queries, image features and history to the BEV map."""

    cell_centers: Tensor

    def __init__(
        self,
        config: EncoderConfig,
        channels: int,
        levels: int,
        grid: BevGrid,
        history_shift: Literal["both", "history"],
    ) -> None:
        super().__init__()
        bev_shape = (grid.rows, grid.columns)
        self.layers = nn.ModuleList(EncoderLayer(config, channels, levels, bev_shape) for _ in range(config.layers))
        self.history_shift = history_shift
        self.register_buffer("cell_centers", _normalized_centers(grid), persistent=False)

    def forward(
        self,
        bev_query: Tensor,
        position: Tensor,
        image_features: FeatureMaps,
        hits: PillarHits,
        history: Tensor | None,
        shift: Tensor,
        probe: AttentionProbe | None = None,
    ) -> Tensor:
        """bev_query: (B, Y·X, C). position: (Y·X, C). image_features: B·N maps.

        history: (B, Y·X, C) rotated, or None. shift: (B, 2). Returns the BEV map (B, Y·X, C).
        """
        # With history, every layer looks at the same two maps; without it, at its own queries twice.
        bev_maps = None if history is None else torch.stack([history, bev_query], dim=1)
        reference_points = self._reference_points(None if history is None else shift)
        bev = bev_query
        for index, layer in enumerate(self.layers):
            bev = layer(
                bev,
                position,
                bev_maps,
                reference_points,
                image_features,
                hits,
                probe if probe is not None and probe.layer == index else None,
            )
        if probe is not None and history is None:
            probe.history_share = None
        return bev

    def _reference_points(self, shift: Tensor | None) -> Tensor:
        """(B or 1, 2, Y·X, 2) float32: the cells' centres in the history map and in the current one."""
        centers = self.cell_centers.float()
        if shift is None:
            return centers.expand(1, 2, -1, -1)
        moved = centers + shift.float()[:, None]  # (B, Y·X, 2)
        current = moved if self.history_shift == "both" else centers.expand_as(moved)
        return torch.stack([moved, current], dim=1)


class EncoderLayer(nn.Module):
    """One of the encoder's layers; a norm after each residual."""

    def __init__(self, config: EncoderConfig, channels: int, levels: int, bev_shape: tuple[int, int]) -> None:
        super().__init__()
        heads, dropout = config.attention_heads, config.dropout
        self.temporal_self_attention = TemporalSelfAttention(
            channels, heads, config.temporal_points, bev_shape, dropout
        )
        self.spatial_cross_attention = SpatialCrossAttention(channels, heads, config.spatial_points, levels, dropout)
        self.feed_forward = FeedForward(channels, config.feed_forward_width, dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(3))

    def forward(
        self,
        query: Tensor,
        position: Tensor,
        bev_maps: Tensor | None,
        reference_points: Tensor,
        image_features: FeatureMaps,
        hits: PillarHits,
        probe: AttentionProbe | None = None,
    ) -> Tensor:
        """query: (B, Y·X, C) -> (B, Y·X, C). bev_maps: (B, 2, Y·X, C), or None without history."""
        maps = torch.stack([query, query], dim=1) if bev_maps is None else bev_maps
        query = self.norms[0](query + self.temporal_self_attention(query, position, maps, reference_points, probe))
        query = self.norms[1](query + self.spatial_cross_attention(query, image_features, hits, probe))
        return self.norms[2](query + self.feed_forward(query))


def _normalized_centers(grid: BevGrid) -> Tensor:
    """(Y·X, 2) float32 centres of the cells, x and y, 0 to 1 over the map."""
    x = (torch.arange(grid.columns, dtype=torch.float32) + 0.5) / grid.columns
    y = (torch.arange(grid.rows, dtype=torch.float32) + 0.5) / grid.rows
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).flatten(0, 1)
