"""The object decoder: queries refined layer by layer on the BEV map, after Deformable DETR."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bevcli.model.deformable_attention import DeformableAttention, sampling_locations
from bevcli.model.detection_head import DetectionHead
from bevcli.model.feed_forward import FeedForward


@dataclass(frozen=True)
class DecoderConfig:
    """queries: object queries. points: sampling points a head of the cross-attention into the BEV map.

    max_boxes: how many of the best-scored boxes are decoded. training_groups: so many sets of queries learn side by
    side, each to find every object (Group DETR, Chen et al. 2023); only the first is used afterwards.
    """

    layers: int = 6
    attention_heads: int = 8
    points: int = 4
    queries: int = 900
    feed_forward_width: int = 512
    dropout: float = 0.1
    max_boxes: int = 300
    training_groups: int = 1

    def __post_init__(self) -> None:
        counts = (self.layers, self.attention_heads, self.points, self.queries, self.max_boxes, self.training_groups)
        if min(*counts, self.feed_forward_width) < 1 or not 0 <= self.dropout < 1:
            raise ValueError(
                "layers, heads, points, queries, boxes, groups and width must be positive, dropout from 0 to below 1"
            )


class Decoder(nn.Module):
    """Object queries that look at the BEV map and move their reference points to the objects.

    kept_first_queries: what the queries have made of each other before they look, where a prepared model keeps it.
    """

    kept_first_queries: Tensor | None = None

    def __init__(self, config: DecoderConfig, channels: int, bev_shape: tuple[int, int]) -> None:
        super().__init__()
        self.training_groups = config.training_groups
        # Of each object query the position half, then the content half.
        self.query_embedding = nn.Parameter(torch.randn(config.training_groups * config.queries, 2 * channels))
        self.reference_points = nn.Linear(channels, 3)
        self.layers = nn.ModuleList(DecoderLayer(config, channels, bev_shape) for _ in range(config.layers))
        nn.init.xavier_uniform_(self.reference_points.weight)
        nn.init.zeros_(self.reference_points.bias)

    def forward(self, bev: Tensor, head: DetectionHead) -> tuple[Tensor, Tensor]:
        """bev: (B, Y·X, C). Returns class logits (L, B, Q, classes) and box codes (L, B, Q, 10), one a layer.

        In training mode Q are the queries of all groups, one group after another.
        """
        groups = self.training_groups if self.training else 1
        position, query = self._queries(groups).expand(len(bev), -1, -1).chunk(2, dim=-1)  # (B, Q, C) each
        reference_points = self.reference_points(position).float().sigmoid()  # (B, Q, 3)
        class_logits, box_codes = [], []
        for index, layer in enumerate(self.layers):
            attended = self.kept_first_queries if index == 0 else None
            query = layer(query, position, reference_points[..., :2], bev, attended, groups)
            logits, codes, refined = head(index, query, reference_points)
            class_logits.append(logits)
            box_codes.append(codes)
            reference_points = refined.detach()
        return torch.stack(class_logits), torch.stack(box_codes)

    def first_queries(self) -> Tensor:
        """(1, Q, C), the queries after the first layer's self-attention: the same in every frame."""
        position, query = self._queries(groups=1)[None].chunk(2, dim=-1)
        first = self.layers[0]
        assert isinstance(first, DecoderLayer)
        return first.attend(query, position)

    def _queries(self, groups: int) -> Tensor:
        """(groups · Q, 2 C), those of the first groups."""
        return self.query_embedding[: len(self.query_embedding) // self.training_groups * groups]


class DecoderLayer(nn.Module):
    """Self-attention among the objects, deformable cross-attention into the BEV map, feed-forward network."""

    def __init__(self, config: DecoderConfig, channels: int, bev_shape: tuple[int, int]) -> None:
        super().__init__()
        self.level_shapes = (bev_shape,)
        dropout = config.dropout
        self.self_attention = nn.MultiheadAttention(channels, config.attention_heads, dropout, batch_first=True)
        self.cross_attention = DeformableAttention(channels, channels, config.attention_heads, config.points)
        self.feed_forward = FeedForward(channels, config.feed_forward_width, dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(3))
        self.dropout = nn.Dropout(dropout)
        nn.init.xavier_uniform_(self.self_attention.out_proj.weight)

    def forward(
        self,
        query: Tensor,
        position: Tensor,
        reference_points: Tensor,
        bev: Tensor,
        attended: Tensor | None = None,
        groups: int = 1,
    ) -> Tensor:
        """query, position: (B, Q, C). reference_points: (B, Q, 2). bev: (B, Y·X, C). Returns (B, Q, C).

        attended: (B or 1, Q, C), the result of `attend` where it is known already.
        groups: queries of different groups do not attend to each other.
        """
        query = self.attend(query, position, groups) if attended is None else attended.expand_as(query)
        looked = self._look_at_bev(query + position, reference_points, bev)
        query = self.norms[1](query + self.dropout(looked))
        return self.norms[2](query + self.feed_forward(query))

    def attend(self, query: Tensor, position: Tensor, groups: int = 1) -> Tensor:
        """query, position: (B, Q, C). The queries (B, Q, C) after the self-attention of each group, and its norm."""
        apart = query.unflatten(1, (groups, -1)).flatten(0, 1)  # (B · groups, Q / groups, C)
        placed = apart + position.unflatten(1, (groups, -1)).flatten(0, 1)
        attended, _ = self.self_attention(placed, placed, apart, need_weights=False)
        return self.norms[0](query + self.dropout(attended.reshape(query.shape)))

    def _look_at_bev(self, query: Tensor, reference_points: Tensor, bev: Tensor) -> Tensor:
        batch, queries, _ = query.shape
        offsets, weights = self.cross_attention.look(query)  # (B, Q, heads, 1, 1, P, 2)
        locations = sampling_locations(reference_points[:, :, None, None, None], offsets[:, :, :, 0], self.level_shapes)
        sampled = self.cross_attention.sample(
            bev, self.level_shapes, locations.flatten(0, 1), weights[:, :, :, 0].flatten(0, 1), [queries] * batch
        )
        return self.cross_attention.output_projection(sampled.unflatten(0, (batch, queries)))
