"""The map head's encoder: layers of deformable self-attention among the cells of the BEV map."""

import math

import torch
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.decoder import DecoderConfig
from bevcli.model.deformable_attention import DeformableAttention, LevelShapes, sampling_locations
from bevcli.model.encoder import FeedForward, normalized_centers

TEMPERATURE = 10_000.0  # of the sine position embedding


class FlatListAttention(DeformableAttention):
    """Deformable attention to one map by a module that was built for several levels, as UniAD's weights were trained.

    It reads locations and weights as the CUDA kernel of the released code does: it takes the flat list of all
    (query, head, level) for a list of the map's L levels. Query n then gets the heads · L entries from n · heads · L
    on. They were predicted by query n · L / (predicted levels), rounded down, and lie around that query's reference
    point. Their weights are not normalised again.
    """

    def attend(self, query: Tensor, reference_points: Tensor, tokens: Tensor, level_shapes: LevelShapes) -> Tensor:
        """See `DeformableAttention`.

        reference_points: (B, Q, 2), or (B, Q, 4) with the extent along x and y: then offsets are measured in half
        extents, divided by the number of points.
        """
        (heads, _, predicted, points), levels, (batch, queries, _) = self.shape, len(level_shapes), query.shape
        read = -(-queries * levels // predicted)  # the queries whose offsets and weights are used
        offsets, logits = self.predict(query[:, :read])  # (B, read, heads, 1, predicted, P, 2)
        offsets, reference = offsets[:, :, :, 0], reference_points[:, :read, None, None, None]
        if reference_points.shape[-1] == 2:
            locations = sampling_locations(reference, offsets, self.sampling.level_sizes(level_shapes, offsets.device))
        else:
            locations = reference[..., :2] + offsets / points * reference[..., 2:] * 0.5
        locations = locations.flatten(1, 3).unflatten(1, (-1, heads, levels))  # (B, Q or more, heads, L, P, 2)
        weights = self.sampling.weights(logits).flatten(1, 4).unflatten(1, (-1, heads, levels))
        samples = locations[:, :queries].flatten(0, 1), weights[:, :queries].flatten(0, 1), [queries] * batch
        sampled = self.sampling(self.values(tokens), level_shapes, *samples)
        attended: Tensor = self.output_projection(sampled.unflatten(0, (batch, queries)))
        return attended


class MapEncoder(nn.Module):
    """Refines the BEV map for the map head. Its result has the shape of the BEV map.

    Attributes:
        position: (Y·X, C) float32, sine position embedding of the cells.
        cell_centers: (Y·X, 2) float32, x and y of the cells' centres, 0 to 1 over the map.
    """

    position: Tensor
    cell_centers: Tensor

    def __init__(self, config: DecoderConfig, channels: int, grid: BevGrid, attention_levels: int) -> None:
        """Random weights. attention_levels: levels that the attentions are built for, although there is one map."""
        super().__init__()
        shape = (grid.rows, grid.columns)
        self.layers = nn.ModuleList(
            MapEncoderLayer(config, channels, shape, attention_levels) for _ in range(config.layers)
        )
        self.level_embedding = nn.Parameter(torch.randn(attention_levels, channels))  # only the first row is used
        self.register_buffer("position", sine_position(*shape, channels), persistent=False)
        self.register_buffer("cell_centers", normalized_centers(grid), persistent=False)

    def forward(self, bev: Tensor) -> Tensor:
        """bev: (B, Y·X, C) -> (B, Y·X, C)."""
        position = self.position + self.level_embedding[0]
        centers = self.cell_centers.expand(len(bev), -1, -1)
        for layer in self.layers:
            bev = layer(bev, position, centers)
        return bev


class MapEncoderLayer(nn.Module):
    """Deformable self-attention and feed-forward network, each with a residual and a norm."""

    def __init__(self, config: DecoderConfig, channels: int, bev_shape: tuple[int, int], attention_levels: int) -> None:
        super().__init__()
        self.level_shapes: LevelShapes = (bev_shape,)
        heads, points = config.attention_heads, config.points
        self.self_attention = FlatListAttention(channels, channels, heads, points, attention_levels)
        self.feed_forward = FeedForward(channels, config.feed_forward_width, config.dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(2))
        self.dropout = nn.Dropout(config.dropout)

    def forward(self, cells: Tensor, position: Tensor, centers: Tensor) -> Tensor:
        """The refined cells (B, Y·X, C).

        cells: (B, Y·X, C). position: (Y·X, C), their embedding. centers: (B, Y·X, 2) x, y, 0 to 1 over the map.
        """
        attended = self.self_attention.attend(cells + position, centers, cells, self.level_shapes)
        cells = self.norms[0](cells + self.dropout(attended))
        return self.norms[1](cells + self.feed_forward(cells))


def sine_position(rows: int, columns: int, channels: int) -> Tensor:
    """(rows · columns, channels) sine position embedding: first that of the row (y), then that of the column (x)."""
    half = channels // 2
    y, x = (_sines(cells, half) for cells in (rows, columns))
    return torch.cat([y[:, None].expand(-1, columns, -1), x.expand(rows, -1, -1)], dim=-1).flatten(0, 1)


def _sines(cells: int, channels: int) -> Tensor:
    """(cells, channels): sine (even channels) and cosine (odd ones) of a cell's centre at falling frequencies."""
    centers = (torch.arange(cells, dtype=torch.float32) + 0.5) / (cells + 1e-6) * (2 * math.pi)
    channel = torch.arange(channels)
    angles = centers[:, None] / TEMPERATURE ** (2 * (channel // 2) / channels)
    return torch.where(channel % 2 == 0, angles.sin(), angles.cos())
