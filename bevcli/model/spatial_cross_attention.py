"""Spatial cross-attention (paper, section 3.3): a BEV cell looks into the cameras that see its pillar."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from bevcli.model.attention_probe import AttentionProbe, SpatialSamples
from bevcli.model.deformable_attention import (
    DeformableAttention,
    FeatureMaps,
    LevelShapes,
    sampling_locations,
)
from bevcli.model.pillar_projection import PillarHits


class SpatialCrossAttention(nn.Module):
    """Deformable attention around a cell's projected pillar points, averaged over the cameras that see the cell."""

    def __init__(self, channels: int, heads: int, points: int, levels: int, dropout: float) -> None:
        super().__init__()
        self.points = points
        self.attention = DeformableAttention(channels, channels, heads, points, levels)
        self.dropout = nn.Dropout(dropout)

    def forward(
        self,
        query: Tensor,
        image_features: FeatureMaps,
        hits: PillarHits,
        probe: AttentionProbe | None = None,
    ) -> Tensor:
        """query: (B, Y·X, C). image_features: B·N maps. Returns (B, Y·X, C), without the residual.

        A cell that no camera sees gets the output projection's bias.
        """
        locations, weights = self._look(query, image_features.level_shapes, hits)
        sampled = self.attention.sample(
            image_features.tokens, image_features.level_shapes, locations, weights, hits.hits_per_camera
        )  # (M, C)
        if probe is not None:
            probe.spatial = _chosen_samples(probe.cells, hits, locations, weights)
        summed = sampled.new_zeros(query.shape).flatten(0, 1).index_add(0, hits.cell, sampled)
        mean = summed / hits.cameras_per_cell.clamp(min=1)[:, None]
        return self.dropout(self.attention.output_projection(mean.view_as(query)))

    def _look(self, query: Tensor, level_shapes: LevelShapes, hits: PillarHits) -> tuple[Tensor, Tensor]:
        """Sampling locations (M, heads, L, P, 2) and weights (M, heads, L, P) of the hits.

        A cell looks the same way in every camera, so this is worked out once a cell.
        """
        offsets, weights = self.attention.look(query.flatten(0, 1))  # (B·Y·X, heads, 1, L, P, 2)
        pillar_points = hits.reference_points.shape[1]
        reference = hits.reference_points.repeat(1, self.points // pillar_points, 1)  # point p: height p mod Z
        offsets, weights = offsets[:, :, 0].index_select(0, hits.cell), weights[:, :, 0].index_select(0, hits.cell)
        return sampling_locations(reference[:, None, None], offsets, level_shapes), weights


def _chosen_samples(cells: Tensor, hits: PillarHits, locations: Tensor, weights: Tensor) -> SpatialSamples:
    counts = torch.tensor(hits.hits_per_camera, device=hits.cell.device)
    camera = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    chosen = torch.isin(hits.cell, cells)
    return SpatialSamples(camera[chosen], hits.cell[chosen], locations[chosen].detach(), weights[chosen].detach())
