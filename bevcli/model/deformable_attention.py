"""Deformable attention (Zhu et al. 2021): each query samples a few values instead of attending to all of them.

query -> sampling_offsets  -> + reference point -> P locations (x) in each level    . . x . .
      -> attention_weights -> softmax           -> P weights, sum 1                 . x o . .
tokens -> value_projection -> values (H, W), sampled bilinearly at the x            . . . x .
sum of weights · samples of each head -> output_projection -> result     o: the reference point
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.model.upload import upload

LevelShapes = tuple[tuple[int, int], ...]
"""(height, width) of each feature level, fine to coarse."""


@dataclass(frozen=True)
class FeatureMaps:
    """G multi-level feature maps as tokens."""

    tokens: Tensor  # (G, S, C), the cells of a map's levels one after another, row by row; S cells in all
    level_shapes: LevelShapes  # (height, width) of each of the L levels

    def scaled(self, scale: Tensor, shift: Tensor) -> "FeatureMaps":
        """The tokens times the scale plus the shift, in their dtype. scale, shift: (G, S, C) float32."""
        return FeatureMaps(torch.addcmul(shift, self.tokens, scale).to(self.tokens.dtype), self.level_shapes)


@dataclass(frozen=True)
class Hits:
    """The M pairs of a value map and a query that samples it, ordered by map.

    Attributes:
        query: (M,) int64, index of the query in B·Q.
        reference_points: (M, Z, 2) float32, x and y, 0 to 1 over the map; sample p lies around point p mod Z.
        hits_per_map: G counts, of sum M.
        prediction: (M,) int64, which of the predictions of its query belongs to the map: an index in the axis "maps" of
            `DeformableAttention.predict`.
    """

    query: Tensor
    reference_points: Tensor
    hits_per_map: Sequence[int]
    prediction: Tensor


SampleHits = Callable[[Tensor, LevelShapes, Hits, Tensor, Tensor], Tensor]
"""The weighted sums (M, C) float32 of hits, without gradients: see `bevcli.model.kernels.compiled.sample_hits`."""


@cache
def hits_of_maps(batch: int, maps: int, cells: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """`Hits.query` and `Hits.prediction` of maps that all cells sample. They are kept: CUDA graphs hold addresses."""
    query = torch.arange(batch * cells, device=device).view(batch, 1, cells).expand(-1, maps, -1).flatten()
    return query, torch.arange(maps, device=device)[None, :, None].repeat(batch, 1, cells).flatten()


class DeformableAttention(nn.Module):
    """The learned parts that the three deformable attentions of BEVFormer share.

    A query predicts where each head samples (offsets from reference points, in cells) and the weight of each sample.

    Attributes:
        sampling: the module that makes the weighted sums; it has no parameters.
    """

    sampling: "GridSampling"

    def __init__(
        self, channels: int, query_channels: int, heads: int, points: int, levels: int = 1, maps: int = 1
    ) -> None:
        """Random weights.

        Args:
            channels: C, of values and results.
            query_channels: channels of the queries.
            heads: number of attention heads, a divisor of C.
            points: P, sampling points of a head in each level.
            levels: L, feature levels of a map.
            maps: value maps that a query samples, each with its own points and its own softmax.
        """
        super().__init__()
        self.shape = (heads, maps, levels, points)
        samples = heads * maps * levels * points
        self.sampling_offsets = nn.Linear(query_channels, samples * 2)
        self.attention_weights = nn.Linear(query_channels, samples)
        self.value_projection = nn.Linear(channels, channels)
        self.output_projection = nn.Linear(channels, channels)
        self.sampling = GridSampling()
        # As published: heads sample in a ring of directions, farther with each point, all with the same weight.
        angles = torch.arange(heads) * (2 * math.pi / heads)
        ring = torch.stack([angles.cos(), angles.sin()], -1)
        ring = ring / ring.abs().amax(-1, keepdim=True)  # (heads, 2)
        bias = ring[:, None, None, None] * torch.arange(1, points + 1)[:, None] * torch.ones(*self.shape, 1)
        nn.init.zeros_(self.sampling_offsets.weight)
        nn.init.zeros_(self.attention_weights.weight)
        nn.init.zeros_(self.attention_weights.bias)
        with torch.no_grad():
            self.sampling_offsets.bias.copy_(bias.flatten())
        for projection in (self.value_projection, self.output_projection):
            nn.init.xavier_uniform_(projection.weight)
            nn.init.zeros_(projection.bias)

    def predict(self, query: Tensor) -> tuple[Tensor, Tensor]:
        """Offsets and logits of the weights of the samples of queries (..., query_channels).

        Offsets (..., heads, maps, L, P, 2) float32, x and y in cells, lie around the reference points; logits are
        (..., heads, maps, L, P), see `GridSampling.weights`.
        """
        offsets, logits = self.sampling_offsets(query), self.attention_weights(query)
        return offsets.float().unflatten(-1, (*self.shape, 2)), logits.unflatten(-1, self.shape)

    def attend(self, query: Tensor, reference_points: Tensor, tokens: Tensor, level_shapes: LevelShapes) -> Tensor:
        """The attended values (B, Q, C) of queries that sample one map each.

        Args:
            query: (B, Q, query_channels).
            reference_points: (B, Q, 2) x, y, 0 to 1 over the map.
            tokens: (B, S, C).
            level_shapes: (height, width) of each of the L levels.
        """
        batch, queries, _ = query.shape
        if self.sampling.sample_hits is not None:
            of_hit = hits_of_maps(1, 1, batch * queries, query.device)
            hits = Hits(of_hit[0], reference_points.reshape(-1, 1, 2), [queries] * batch, of_hit[1])
            predicted = self.predict(query.flatten(0, 1))
            sampled = self.sampling.sample_hits(self.values(tokens), level_shapes, hits, *predicted)
            projected: Tensor = self.output_projection(sampled.view(batch, queries, -1))
            return projected
        offsets, logits = (predicted[:, :, :, 0] for predicted in self.predict(query))
        reference = reference_points[:, :, None, None, None]
        sizes = self.sampling.level_sizes(level_shapes, offsets.device)
        locations, weights = sampling_locations(reference, offsets, sizes), self.sampling.weights(logits)
        samples = locations.flatten(0, 1), weights.flatten(0, 1), [queries] * batch
        sampled = self.sampling(self.values(tokens), level_shapes, *samples)
        attended: Tensor = self.output_projection(sampled.unflatten(0, (batch, queries)))
        return attended

    def values(self, tokens: Tensor) -> Tensor:
        """The values (G, S, heads, C / heads) of tokens (G, S, C)."""
        return self.value_projection(tokens).unflatten(-1, (self.shape[0], -1))


class GridSampling(nn.Module):
    """Weighted sums of bilinearly sampled values, by `grid_sample`, one map after another.

    Attributes:
        sample_hits: a kernel that an attention calls in place of `forward`, without tables of locations and weights.
        kept_sizes: results of `level_sizes`, for inference, where CUDA graphs hold their addresses; None keeps none.
    """

    def __init__(self, *, keeps_sizes: bool = False) -> None:
        super().__init__()
        self.sample_hits: SampleHits | None = None
        self.kept_sizes: dict[tuple[LevelShapes, torch.device], Tensor] | None = {} if keeps_sizes else None

    def weights(self, logits: Tensor) -> Tensor:
        """The weights, whose sum over levels and points is 1, of logits (..., L, P)."""
        return logits.flatten(-2).softmax(-1).view_as(logits)

    def level_sizes(self, level_shapes: LevelShapes, device: torch.device) -> Tensor:
        """(L, 2) float32 width and height of each level, on a device."""
        kept = self.kept_sizes
        if kept is not None and (level_shapes, device) in kept:
            return kept[level_shapes, device]
        sizes = torch.tensor([(width, height) for height, width in level_shapes], dtype=torch.float32)
        sizes = upload(sizes, device)
        if kept is not None:
            kept[level_shapes, device] = sizes
        return sizes

    def forward(
        self,
        values: Tensor,
        level_shapes: LevelShapes,
        locations: Tensor,
        weights: Tensor,
        queries_per_map: Sequence[int],
    ) -> Tensor:
        """M queries sample G maps. Returns (M, heads · D) float32, whatever the dtype of the values.

        Args:
            values: (G, S, heads, D), the cells of a map's L levels one after another, S in all.
            level_shapes: (height, width) of each level.
            locations: (M, heads, L, P, 2) float32, x and y, 0 to 1 over a level's map; values outside are zero.
            weights: (M, heads, L, P).
            queries_per_map: G counts, of sum M: the first queries_per_map[0] queries sample map 0, and so on.
        """
        counts = list(queries_per_map)
        parts = zip(values, locations.split(counts), weights.split(counts), strict=True)
        return torch.cat([sample_maps(v[None], level_shapes, xy[None], w[None])[0] for v, xy, w in parts])


def sample_maps(values: Tensor, level_shapes: LevelShapes, locations: Tensor, weights: Tensor) -> Tensor:
    """Weighted sums (G, m, heads · D) float32 where every map is sampled by m queries.

    Args:
        values: (G, S, heads, D).
        level_shapes: (height, width) of each level.
        locations: (G, m, heads, L, P, 2), x and y, 0 to 1 over a level's map; values outside are zero.
        weights: (G, m, heads, L, P).
    """
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


def sampling_locations(reference_points: Tensor, offsets: Tensor, sizes: Tensor) -> Tensor:
    """Reference points plus offsets: (..., L, P, 2) float32, x and y, 0 to 1 over a map.

    Args:
        reference_points: (..., L or 1, P or 1, 2) x and y, 0 to 1 over a map; up to 1e6 behind a camera.
        offsets: (..., L, P, 2) x and y in cells of each level.
        sizes: (L, 2) float32 width and height of each level, see `GridSampling.level_sizes`.
    """
    # Broadcasting over a last axis of two elements takes several times as long as dividing full tensors.
    sizes = sizes[:, None].expand(offsets.shape[-3:]).contiguous()  # (L, P, 2)
    reference_points = reference_points.float().expand(*reference_points.shape[:-2], *offsets.shape[-2:]).contiguous()
    return reference_points + offsets.float() / sizes
