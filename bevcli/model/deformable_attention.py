"""Deformable attention (Zhu et al. 2021): a few sampled values a query in place of all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.model.kernels.compiled_attention import sample_compiled

LevelShapes = tuple[tuple[int, int], ...]
"""(height, width) of each feature level, fine to coarse."""


@dataclass(frozen=True)
class FeatureMaps:
    """G multi-level maps as tokens (G, S, C): the cells of a map's levels one after another, row by row."""

    tokens: Tensor
    level_shapes: LevelShapes


Backend = Literal["grid_sample", "padded", "compiled", "triton"]
"""grid_sample: map by map, with gradients. padded: the textbook's, all maps at once, their queries padded to the
longest list. compiled: loops on the CPU, with gradients. triton: a kernel on a GPU, without."""


def deformable_attention(
    values: Tensor,
    level_shapes: LevelShapes,
    locations: Tensor,
    weights: Tensor,
    queries_per_map: Sequence[int],
    backend: Backend = "grid_sample",
) -> Tensor:
    """Weighted sums of values sampled at given places: the one front of the operation.

    values: (G, S, heads, D), G maps, each the cells of its L levels one after another, S in all.
    locations: (M, heads, L, P, 2) float32, x and y, 0 to 1 over a level's map; outside of it values are zero.
    weights: (M, heads, L, P). queries_per_map: G counts, of sum M: the first queries_per_map[0] queries sample
    map 0, and so on. Returns (M, heads · D) float32, whatever values is. All backends answer the same up to rounding.
    """
    return _IMPLEMENTATIONS[backend](values, level_shapes, locations, weights, queries_per_map)


def fastest_backend(device: torch.device, *, gradients: bool = False) -> Backend:
    """What to run on a device. gradients: whether they are asked for."""
    if device.type == "cpu":
        return "compiled"
    return "triton" if device.type == "cuda" and find_spec("triton") and not gradients else "grid_sample"


def _sample_map_by_map(
    values: Tensor, level_shapes: LevelShapes, locations: Tensor, weights: Tensor, queries_per_map: Sequence[int]
) -> Tensor:
    counts = list(queries_per_map)
    parts = zip(values, locations.split(counts), weights.split(counts), strict=True)
    return torch.cat([_grid_sample(v[None], level_shapes, where[None], w[None])[0] for v, where, w in parts])


def _sample_padded(
    values: Tensor, level_shapes: LevelShapes, locations: Tensor, weights: Tensor, queries_per_map: Sequence[int]
) -> Tensor:
    counts = torch.tensor(queries_per_map, device=values.device)
    longest = max(queries_per_map)
    kept = torch.arange(longest, device=values.device) < counts[:, None]  # (G, longest)
    padded_locations = locations.new_zeros(len(counts), longest, *locations.shape[1:])
    padded_weights = weights.new_zeros(len(counts), longest, *weights.shape[1:])
    padded_locations[kept], padded_weights[kept] = locations, weights
    return _grid_sample(values, level_shapes, padded_locations, padded_weights)[kept]


def _grid_sample(values: Tensor, level_shapes: LevelShapes, locations: Tensor, weights: Tensor) -> Tensor:
    """values (G, S, heads, D), locations (G, m, heads, L, P, 2), weights (G, m, heads, L, P) -> (G, m, heads · D)."""
    maps, _, heads, _ = values.shape
    result = values.new_zeros((), dtype=torch.float32)
    grid = (2 * locations.float() - 1).permute(3, 0, 2, 1, 4, 5).flatten(1, 2)  # (L, G·heads, m, P, 2)
    level_weights = weights.float().permute(3, 0, 2, 1, 4).flatten(1, 2)  # (L, G·heads, m, P)
    sizes = [height * width for height, width in level_shapes]
    for level, cells in enumerate(values.float().split(sizes, dim=1)):
        level_map = cells.permute(0, 2, 3, 1).flatten(0, 1).unflatten(-1, level_shapes[level])  # (G·heads, D, H, W)
        sampled = F.grid_sample(level_map, grid[level], align_corners=False)  # (G·heads, D, m, P)
        result = result + (sampled * level_weights[level, :, None]).sum(-1)
    return result.unflatten(0, (maps, heads)).permute(0, 3, 1, 2).flatten(2)  # (G, m, heads · D)


def _sample_on_gpu(
    values: Tensor, level_shapes: LevelShapes, locations: Tensor, weights: Tensor, queries_per_map: Sequence[int]
) -> Tensor:
    from bevcli.model.kernels.triton_attention import sample_triton  # only where Triton is installed

    return sample_triton(values, level_shapes, locations, weights, queries_per_map)


_IMPLEMENTATIONS = {
    "grid_sample": _sample_map_by_map,
    "padded": _sample_padded,
    "compiled": sample_compiled,
    "triton": _sample_on_gpu,
}


class DeformableAttention(nn.Module):
    """The learned parts that the three deformable attentions of BEVFormer share.

    A query says where each head looks (offsets from reference points, in cells) and how much each place counts.
    maps: value maps that a query looks at, each with its own points and its own softmax.
    `backend` says how values are sampled; a model starts with PyTorch's own, which runs everywhere.
    """

    backend: Backend = "grid_sample"

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
        tokens = tokens.to(self.value_projection.weight.dtype)
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

    def sample(
        self,
        tokens: Tensor,
        level_shapes: LevelShapes,
        locations: Tensor,
        weights: Tensor,
        queries_per_map: Sequence[int],
    ) -> Tensor:
        """`deformable_attention` with the values of tokens (G, S, C) and this module's backend -> (M, C)."""
        values = self.project_values(tokens)
        return deformable_attention(values, level_shapes, locations, weights, queries_per_map, self.backend)

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
    sizes = torch.tensor(widths_heights, dtype=torch.float32, device=offsets.device)[:, None]
    # Laid out in full: two numbers at a time, x and y, take several times as long.
    sizes = sizes.expand(offsets.shape[-3:]).contiguous()
    reference_points = reference_points.float().expand(*reference_points.shape[:-2], *offsets.shape[-2:]).contiguous()
    return reference_points + offsets.float() / sizes
