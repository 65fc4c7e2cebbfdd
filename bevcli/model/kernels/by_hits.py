"""The attentions of the encoder by one kernel for all hits, without tables of locations and weights. No gradients."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from bevcli.model.deformable_attention import DeformableAttention, FeatureMaps, LevelShapes
from bevcli.model.encoder import SpatialCrossAttention, TemporalSelfAttention
from bevcli.model.pillar_projection import PillarHits


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
"""The weighted sums (M, C) float32 of hits: see `bevcli.model.kernels.compiled.sample_hits`."""


class TemporalByHits(TemporalSelfAttention):
    """A `TemporalSelfAttention` whose cells hit the history and the current map."""

    sample_hits: SampleHits

    def sample(self, bev_maps: Tensor, reference_points: Tensor, offsets: Tensor, logits: Tensor) -> Tensor:
        """As `TemporalSelfAttention.sample`."""
        (batch, cells), maps, values = (
            offsets.shape[:2],
            bev_maps.shape[1],
            self.attention.values(bev_maps.flatten(0, 1)),
        )
        hits = temporal_hits(reference_points.expand(batch, -1, -1, -1), [2 * cells // maps] * (maps * batch))
        sampled = self.sample_hits(values, self.level_shapes, hits, offsets.flatten(0, 1), logits.flatten(0, 1))
        return self.mean(sampled.unflatten(0, (batch, 2, cells)))


class SpatialByHits(SpatialCrossAttention):
    """A `SpatialCrossAttention` whose hits are those of the pillars."""

    sample_hits: SampleHits

    def sample(self, query: Tensor, image_features: FeatureMaps, hits: PillarHits) -> Tensor:
        """As `SpatialCrossAttention.sample`."""
        predicted = self.attention.predict(query.flatten(0, 1))  # (B·Y·X, heads, 1, …) each
        values = self.attention.values(image_features.tokens)
        by_map = Hits(hits.cell, hits.reference_points, hits.hits_per_camera, torch.zeros_like(hits.cell))
        return self.sample_hits(values, image_features.level_shapes, by_map, *predicted)


class AttentionByHits(DeformableAttention):
    """A `DeformableAttention` whose queries hit the one map around their reference points."""

    sample_hits: SampleHits

    def attend(self, query: Tensor, reference_points: Tensor, tokens: Tensor, level_shapes: LevelShapes) -> Tensor:
        """As `DeformableAttention.attend`."""
        batch, queries, _ = query.shape
        of_hit = map_queries(1, 1, batch * queries, query.device)
        hits = Hits(of_hit[0], reference_points.reshape(-1, 1, 2), [queries] * batch, of_hit[1])
        sampled = self.sample_hits(self.values(tokens), level_shapes, hits, *self.predict(query.flatten(0, 1)))
        result: Tensor = self.output_projection(sampled.view(batch, queries, -1))
        return result


def temporal_hits(reference_points: Tensor, queries_per_map: Sequence[int]) -> Hits:
    """The hits of the BEV cells in the history and the current map. reference_points: (B, 2, Y·X, 2)."""
    batch, maps, cells, _ = reference_points.shape
    query, prediction = map_queries(batch, maps, cells, reference_points.device)
    return Hits(query, reference_points.reshape(-1, 1, 2), queries_per_map, prediction)


@cache
def map_queries(batch: int, maps: int, cells: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """`Hits.query` and `Hits.prediction` of maps that all cells sample. They are kept: CUDA graphs hold addresses."""
    query = torch.arange(batch * cells, device=device).view(batch, 1, cells).expand(-1, maps, -1).flatten()
    return query, torch.arange(maps, device=device)[None, :, None].repeat(batch, 1, cells).flatten()
