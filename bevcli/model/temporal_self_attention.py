"""Temporal self-attention (paper, section 3.4): a BEV cell looks around itself, now and in the history map."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from bevcli.model.attention_probe import AttentionProbe
from bevcli.model.deformable_attention import (
    DeformableAttention,
    LevelShapes,
    sampling_locations,
)


class TemporalSelfAttention(nn.Module):
    """Deformable attention of BEV queries into two BEV maps, history and current, whose results are averaged."""

    def __init__(self, channels: int, heads: int, points: int, bev_shape: tuple[int, int], dropout: float) -> None:
        super().__init__()
        self.level_shapes: LevelShapes = (bev_shape,)
        # The history and the query together say where to look.
        self.attention = DeformableAttention(channels, 2 * channels, heads, points, maps=2)
        self.dropout = nn.Dropout(dropout)

    def forward(
        self,
        query: Tensor,
        position: Tensor,
        bev_maps: Tensor,
        reference_points: Tensor,
        probe: AttentionProbe | None = None,
    ) -> Tensor:
        """query: (B, Y·X, C). position: (Y·X, C). bev_maps: (B, 2, Y·X, C), history first.

        reference_points: (B or 1, 2, Y·X, 2) x, y, 0 to 1, one a map. Returns (B, Y·X, C), without the residual.
        """
        batch, cells, _ = query.shape
        offsets, weights = self.attention.look(torch.cat([bev_maps[:, 0], query + position], dim=-1))
        reference = reference_points.transpose(1, 2)[:, :, None, :, None, None]  # (B, Y·X, 1, 2, 1, 1, 2)
        locations = sampling_locations(reference, offsets, self.level_shapes)  # (B, Y·X, heads, 2, 1, P, 2)
        sampled = self.attention.sample(
            bev_maps.flatten(0, 1),
            self.level_shapes,
            locations.movedim(3, 1).flatten(0, 2),
            weights.movedim(3, 1).flatten(0, 2),
            [cells] * (2 * batch),
        ).unflatten(0, (batch, 2, cells))
        if probe is not None:
            lengths = sampled.detach().norm(dim=-1)  # (B, 2, Y·X)
            probe.history_share = lengths[:, 0] / lengths.sum(1).clamp(min=1e-12)
        return self.dropout(self.attention.output_projection(sampled.mean(1)))
