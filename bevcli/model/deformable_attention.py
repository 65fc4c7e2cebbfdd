"""Deformable attention (Zhu et al. 2021): a few sampled values a query in place of all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

LevelShapes = tuple[tuple[int, int], ...]
"""(height, width) of each feature level, fine to coarse."""


@dataclass(frozen=True)
class FeatureMaps:
    """G multi-level maps as tokens (G, S, C): the cells of a map's levels one after another, row by row."""

    tokens: Tensor
    level_shapes: LevelShapes


def deformable_attention(
    values: Tensor, level_shapes: LevelShapes, locations: Tensor, weights: Tensor, queries_per_map: Sequence[int]
) -> Tensor:
    """Weighted sums of values sampled at given places: the one front of the operation.

    values: (G, S, heads, D), G maps, each the cells of its L levels one after another, S in all.
    locations: (M, heads, L, P, 2) float32, x and y, 0 to 1 over a level's map; outside of it values are zero.
    weights: (M, heads, L, P). queries_per_map: G counts, of sum M: the first queries_per_map[0] queries sample
    map 0, and so on. Returns (M, heads · D) in the dtype of values.
    """
    parts = zip(values, locations.split(list(queries_per_map)), weights.split(list(queries_per_map)), strict=True)
    return torch.cat([_sample_one_map(value, level_shapes, where, weight) for value, where, weight in parts])


def _sample_one_map(values: Tensor, level_shapes: LevelShapes, locations: Tensor, weights: Tensor) -> Tensor:
    """The plain version: values (S, heads, D), locations (m, heads, L, P, 2), weights -> (m, heads · D)."""
    result = values.new_zeros((), dtype=torch.float32)
    grid = (2 * locations.float() - 1).permute(2, 1, 0, 3, 4)  # (L, heads, m, P, 2)
    level_weights = weights.float().permute(2, 1, 0, 3)  # (L, heads, m, P)
    sizes = [height * width for height, width in level_shapes]
    for level, cells in enumerate(values.float().split(sizes)):
        level_map = cells.permute(1, 2, 0).unflatten(-1, level_shapes[level])  # (heads, D, H, W)
        sampled = F.grid_sample(level_map, grid[level], align_corners=False)  # (heads, D, m, P)
        result = result + (sampled * level_weights[level, :, None]).sum(-1)
    return result.permute(2, 0, 1).flatten(1).to(values.dtype)  # (m, heads · D)


class DeformableAttention(nn.Module):
    """The learned parts that the three deformable attentions of BEVFormer share.

    A query says where each head looks (offsets from reference points, in cells) and how much each place counts.
    maps: value maps that a query looks at, each with its own points and its own softmax.
    """

    def __init__(
        self, channels: int, query_channels: int, heads: int, points: int, levels: int = 1, maps: int = 1
    ) -> None:
        super().__init__()
        self.shape = (heads, maps, levels, points)
        places = heads * maps * levels * points
        self.sampling_offsets = nn.Linear(query_channels, places * 2)
        self.attention_weights = nn.Linear(query_channels, places)
        self.value_projection = nn.Linear(channels, channels)
        self.output_projection = nn.Linear(channels, channels)
        self._initialize()

    def project_values(self, tokens: Tensor) -> Tensor:
        """tokens: (G, S, C) -> values (G, S, heads, C / heads)."""
        return self.value_projection(tokens).unflatten(-1, (self.shape[0], -1))

    def look(self, query: Tensor) -> tuple[Tensor, Tensor]:
        """query: (..., query_channels) -> how it looks around its reference points.

        Returns offsets (..., heads, maps, L, P, 2) float32 in cells, x and y, and weights (..., heads, maps, L, P),
        which for a head and map sum to one over levels and points.
        """
        offsets = self.sampling_offsets(query).float().unflatten(-1, (*self.shape, 2))
        heads, maps, levels, points = self.shape
        weights = self.attention_weights(query).unflatten(-1, (heads, maps, levels * points)).softmax(-1)
        return offsets, weights.unflatten(-1, (levels, points))

    def _initialize(self) -> None:
        """As published: heads look in a ring of directions, further with each point, and weigh places equally."""
        heads = self.shape[0]
        angles = torch.arange(heads) * (2 * math.pi / heads)
        ring = torch.stack([angles.cos(), angles.sin()], -1)
        ring = ring / ring.abs().amax(-1, keepdim=True)  # (heads, 2)
        steps = torch.arange(1, self.shape[-1] + 1)
        bias = ring[:, None, None, None] * steps[:, None] * torch.ones(*self.shape, 1)
        nn.init.zeros_(self.sampling_offsets.weight)
        nn.init.zeros_(self.attention_weights.weight)
        nn.init.zeros_(self.attention_weights.bias)
        with torch.no_grad():
            self.sampling_offsets.bias.copy_(bias.flatten())
        for projection in (self.value_projection, self.output_projection):
            nn.init.xavier_uniform_(projection.weight)
            nn.init.zeros_(projection.bias)


def sampling_locations(reference_points: Tensor, offsets: Tensor, level_shapes: LevelShapes) -> Tensor:
    """Where to sample: reference points (..., L or 1, P or 1, 2) plus offsets (..., L, P, 2) in cells of each level.

    All x, y, 0 to 1 over a map, in float32: a point behind a camera may lie 1e6 away.
    """
    widths_heights = [(width, height) for height, width in level_shapes]
    sizes = torch.tensor(widths_heights, dtype=torch.float32, device=offsets.device)
    return reference_points.float() + offsets.float() / sizes[:, None]
