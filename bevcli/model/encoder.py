"""The BEV encoder: layers of temporal self-attention, spatial cross-attention and a feed-forward network."""

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.deformable_attention import (
    DeformableAttention,
    FeatureMaps,
    Hits,
    LevelShapes,
    hits_of_maps,
    sampling_locations,
)
from bevcli.model.ego_motion import EgoMotionConfig
from bevcli.model.pillar_projection import PillarHits
from bevcli.parsing.documents import Count, ShareBelowOne


@dataclass(frozen=True)
class EncoderConfig:
    """The encoder."""

    layers: Count = 6  # number of encoder layers
    attention_heads: Count = 8  # heads of both attentions
    temporal_points: Count = 4  # sampling points of a head in each of the two BEV maps
    spatial_points: Count = 8  # sampling points of a head in each feature level, a multiple of the grid's pillar points
    feed_forward_width: Count = 512  # channels between the two linear layers of the feed-forward network
    dropout: ShareBelowOne = 0.1  # probability


class Encoder(nn.Module):
    """BEV queries, image features and history to the BEV map.

    Attributes:
        cell_centers: (Y·X, 2) float32, x and y of the cells' centres, 0 to 1 over the map.
    """

    cell_centers: Tensor

    def __init__(
        self, config: EncoderConfig, channels: int, levels: int, grid: BevGrid, ego_motion: EgoMotionConfig
    ) -> None:
        super().__init__()
        bev_shape = (grid.rows, grid.columns)
        self.layers = nn.ModuleList(EncoderLayer(config, channels, levels, bev_shape) for _ in range(config.layers))
        self.history_shift = ego_motion.history_shift
        self.shift_without_history = ego_motion.first_frame == "original"
        self.register_buffer("cell_centers", normalized_centers(grid), persistent=False)

    def forward(
        self,
        bev_query: Tensor,
        position: Tensor,
        image_features: FeatureMaps,
        hits: PillarHits,
        history: Tensor | None = None,
        shift: Tensor | None = None,
    ) -> Tensor:
        """The BEV map (B, Y·X, C).

        Args:
            bev_query: (B, Y·X, C).
            position: (Y·X, C), position embedding of the cells.
            image_features: tokens of B·N images.
            hits: the cells that each camera sees.
            history: (B, Y·X, C), the previous BEV map, rotated to the current heading; None without history.
            shift: (B, 2), translation of the history (x, y) in normalised BEV coordinates; needed with history, and
                where ego_motion.first_frame is "original".
        """
        # With history, all layers attend to the same two maps; without it, to their own queries twice.
        bev_maps = None if history is None else torch.stack([history, bev_query], dim=1)
        is_shifted = history is not None or self.shift_without_history
        reference_points = self.reference_points(shift if is_shifted else None)
        bev = bev_query
        for layer in self.layers:
            bev = layer(bev, position, bev_maps, reference_points, image_features, hits)
        return bev

    def reference_points(self, shift: Tensor | None) -> Tensor:
        """(B or 1, 2, Y·X, 2) float32: where the cells' centres lie in the history map and in the current one.

        shift: as for `forward`; None where the history is not shifted.
        """
        centers = self.cell_centers.float()
        if shift is None:
            return centers.expand(1, 2, -1, -1)
        moved = centers + shift.float()[:, None]  # (B, Y·X, 2)
        current = moved if self.history_shift == "both" else centers.expand_as(moved)
        return torch.stack([moved, current], dim=1)


class EncoderLayer(nn.Module):
    """Temporal self-attention, spatial cross-attention and feed-forward network, each with a residual and a norm."""

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
    ) -> Tensor:
        """The refined queries (B, Y·X, C). Other arguments as for `Encoder.forward`.

        Args:
            query: (B, Y·X, C).
            bev_maps: (B, 2, Y·X, C), history and current BEV queries; None without history.
            reference_points: (B or 1, 2, Y·X, 2) x, y, 0 to 1, in each of the two maps.
        """
        maps = query[:, None] if bev_maps is None else bev_maps
        query = self.norms[0](query + self.temporal_self_attention(query, position, maps, reference_points))
        query = self.norms[1](query + self.spatial_cross_attention(query, image_features, hits))
        return self.norms[2](query + self.feed_forward(query))


class TemporalSelfAttention(nn.Module):
    """Deformable attention of BEV queries to history and current BEV map, averaged (paper, section 3.4)."""

    def __init__(self, channels: int, heads: int, points: int, bev_shape: tuple[int, int], dropout: float) -> None:
        super().__init__()
        self.level_shapes: LevelShapes = (bev_shape,)
        # Offsets and weights are predicted from the history and the query together.
        self.attention = DeformableAttention(channels, 2 * channels, heads, points, maps=2)
        self.dropout = nn.Dropout(dropout)

    def forward(self, query: Tensor, position: Tensor, bev_maps: Tensor, reference_points: Tensor) -> Tensor:
        """The attended values (B, Y·X, C), without the residual.

        Args:
            query: (B, Y·X, C).
            position: (Y·X, C).
            bev_maps: (B, 2, Y·X, C), history first; (B, 1, Y·X, C) where both are the same map.
            reference_points: (B or 1, 2, Y·X, 2) x, y, 0 to 1, in each of the two maps.
        """
        offsets, logits = self.attention.predict(torch.cat([bev_maps[:, 0], query + position], dim=-1))
        return self.sample(bev_maps, reference_points, offsets, logits)

    def sample(self, bev_maps: Tensor, reference_points: Tensor, offsets: Tensor, logits: Tensor) -> Tensor:
        """The attended values (B, Y·X, C) for given offsets and logits of the samples; see `forward`."""
        (batch, cells), maps = offsets.shape[:2], bev_maps.shape[1]
        tokens, queries_per_map = bev_maps.flatten(0, 1), [2 * cells // maps] * (maps * batch)
        sampling = self.attention.sampling
        if sampling.sample_hits is not None:
            query, prediction = hits_of_maps(batch, 2, cells, reference_points.device)
            points = reference_points.expand(batch, -1, -1, -1).reshape(-1, 1, 2)
            hits = Hits(query, points, queries_per_map, prediction)
            predicted = offsets.flatten(0, 1), logits.flatten(0, 1)
            sampled = sampling.sample_hits(self.attention.values(tokens), self.level_shapes, hits, *predicted)
        else:
            reference = reference_points.transpose(1, 2)[:, :, None, :, None, None]  # (B, Y·X, 1, 2, 1, 1, 2)
            locations = sampling_locations(reference, offsets, sampling.level_sizes(self.level_shapes, offsets.device))
            locations = locations.movedim(3, 1).flatten(0, 2)  # of (B, Y·X, heads, 2, 1, P, 2)
            weights = sampling.weights(logits).movedim(3, 1).flatten(0, 2)
            values = self.attention.values(tokens)
            sampled = sampling(values, self.level_shapes, locations, weights, queries_per_map)
        return self.mean(sampled.unflatten(0, (batch, 2, cells)))

    def mean(self, sampled: Tensor) -> Tensor:
        """The attended values (B, Y·X, C) of what was sampled in the two maps (B, 2, Y·X, C)."""
        of_history, of_current = sampled.unbind(1)
        return self.dropout(self.attention.output_projection((of_history + of_current) / 2))


class SpatialCrossAttention(nn.Module):
    """Deformable attention of BEV queries to the cameras that see their pillars (paper, section 3.3).

    Samples lie around the projected points of a pillar. The results of the cameras that see a cell are averaged.
    """

    def __init__(self, channels: int, heads: int, points: int, levels: int, dropout: float) -> None:
        super().__init__()
        self.points = points
        self.attention = DeformableAttention(channels, channels, heads, points, levels)
        self.dropout = nn.Dropout(dropout)

    def forward(self, query: Tensor, image_features: FeatureMaps, hits: PillarHits) -> Tensor:
        """Attended values (B, Y·X, C) without the residual; the output projection's bias where no camera sees a cell.

        query: (B, Y·X, C). image_features: tokens of B·N images. hits: the M pairs of a camera and a cell that it sees.
        """
        sampled = self.sample(query, image_features, hits)  # (M, C)
        summed = sampled.new_zeros(query.shape).flatten(0, 1).index_add(0, hits.cell, sampled)
        mean = summed / hits.cameras_per_cell.clamp(min=1)[:, None]
        return self.dropout(self.attention.output_projection(mean.view_as(query)))

    def sample(self, query: Tensor, image_features: FeatureMaps, hits: PillarHits) -> Tensor:
        """The weighted sums (M, C) of the hits; see `forward`."""
        # A cell has the same offsets and logits in every camera, so they are predicted once for each cell.
        predicted = self.attention.predict(query.flatten(0, 1))  # (B·Y·X, heads, 1, …) each
        tokens, level_shapes = image_features.tokens, image_features.level_shapes
        sampling = self.attention.sampling
        if sampling.sample_hits is not None:
            by_map = Hits(hits.cell, hits.reference_points, hits.hits_per_camera, torch.zeros_like(hits.cell))
            return sampling.sample_hits(self.attention.values(tokens), level_shapes, by_map, *predicted)
        offsets, logits = (tensor[:, :, 0] for tensor in predicted)
        pillar_points = hits.reference_points.shape[1]
        reference = hits.reference_points.repeat(1, self.points // pillar_points, 1)  # point p: height p mod Z
        offsets, weights = (x.index_select(0, hits.cell) for x in (offsets, sampling.weights(logits)))
        sizes = sampling.level_sizes(level_shapes, offsets.device)
        locations = sampling_locations(reference[:, None, None], offsets, sizes)  # (M, heads, L, P, 2)
        values = self.attention.values(tokens)
        sampled: Tensor = sampling(values, level_shapes, locations, weights, hits.hits_per_camera)
        return sampled


def normalized_centers(grid: BevGrid) -> Tensor:
    """(Y·X, 2) float32 centres of the cells, x and y, 0 to 1 over the map."""
    x = (torch.arange(grid.columns, dtype=torch.float32) + 0.5) / grid.columns
    y = (torch.arange(grid.rows, dtype=torch.float32) + 0.5) / grid.rows
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).flatten(0, 1)


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
