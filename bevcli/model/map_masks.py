"""The map head's mask decoder: queries attend to all cells of the map, and their last attention becomes their masks."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.model.feed_forward import FeedForward
from bevcli.model.segmentation import split_heads

NORM_EPS = 1e-6
QUERIES_AT_ONCE = 20  # the attention maps of all queries together would need hundreds of megabytes


class MaskDecoder(nn.Module):
    """Layers of attention to the cells, and a mask for each query."""

    def __init__(self, channels: int, heads: int, layers: int, width: int, *, self_attention: bool) -> None:
        """Random weights.

        Args:
            channels: C.
            heads: of all attentions.
            layers: number of layers before the masks.
            width: channels between the two linear layers of a feed-forward network.
            self_attention: whether the queries of a layer attend to each other first.
        """
        super().__init__()
        self.layers = nn.ModuleList(MaskLayer(channels, heads, width, self_attention) for _ in range(layers))
        self.masks = MaskProjection(channels, heads)

    def forward(self, query: Tensor, cells: Tensor, position: Tensor | None = None) -> Tensor:
        """The masks.

        Args:
            query: (B, Q, C).
            cells: (B, Y·X, C).
            position: (Q, C), added to the queries before each layer and before the masks; None for none.

        Returns:
            (B, Q, Y·X), 0 or larger, without an upper limit. A cell belongs to a mask where it is larger than 0.5.
        """
        for layer in self.layers:
            query = layer(query if position is None else query + position, cells)
        return self.masks(query if position is None else query + position, cells)


class MaskLayer(nn.Module):
    """Self-attention (where there is one), attention to all cells, and feed-forward network, with norms."""

    def __init__(self, channels: int, heads: int, width: int, self_attention: bool) -> None:
        super().__init__()
        self.heads = heads
        self.self_attention = nn.MultiheadAttention(channels, heads, batch_first=True) if self_attention else None
        self.self_attention_norm = nn.LayerNorm(channels, NORM_EPS) if self_attention else None
        self.query_projection = nn.Linear(channels, channels)
        self.key_projection = nn.Linear(channels, channels)
        self.value_projection = nn.Linear(channels, channels)
        self.output_projection = nn.Linear(channels, channels)
        self.feed_forward = FeedForward(channels, width, dropout=0.0, activation="gelu")
        self.norms = nn.ModuleList(nn.LayerNorm(channels, NORM_EPS) for _ in range(2))

    def forward(self, query: Tensor, cells: Tensor) -> Tensor:
        """query: (B, Q, C), cells: (B, Y·X, C) -> refined queries (B, Q, C)."""
        if self.self_attention is not None and self.self_attention_norm is not None:
            attended, _ = self.self_attention(query, query, query, need_weights=False)
            query = self.self_attention_norm(query + attended)
        queries = split_heads(self.query_projection(query), self.heads)
        keys, values = (split_heads(part(cells), self.heads) for part in (self.key_projection, self.value_projection))
        attended = F.scaled_dot_product_attention(queries, keys, values)  # (B, heads, Q, C / heads)
        query = self.norms[0](query + self.output_projection(attended.transpose(1, 2).flatten(2)))
        return self.norms[1](query + self.feed_forward(query))


class MaskProjection(nn.Module):
    """Masks from the attention of the queries to the cells: two layers of ReLU over the heads."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query_projection = nn.Linear(channels, channels)
        self.key_projection = nn.Linear(channels, channels)
        self.hidden = nn.Linear(heads, heads)
        self.output = nn.Linear(heads, 1)

    def forward(self, query: Tensor, cells: Tensor) -> Tensor:
        """query: (B, Q, C), cells: (B, Y·X, C) -> masks (B, Q, Y·X), 0 or larger."""
        queries = split_heads(self.query_projection(query), self.heads)
        keys = split_heads(self.key_projection(cells), self.heads).transpose(-1, -2)  # (B, heads, C / heads, Y·X)
        parts = (part @ keys / math.sqrt(part.shape[-1]) for part in queries.split(QUERIES_AT_ONCE, dim=2))
        return torch.cat([self._masks(part) for part in parts], dim=1)

    def _masks(self, attention: Tensor) -> Tensor:
        """attention: (B, heads, q, Y·X) -> (B, q, Y·X)."""
        for layer in (self.hidden, self.output):
            attention = torch.einsum("gh,bhqs->bgqs", layer.weight, attention) + layer.bias[:, None, None]
            attention = attention.relu_()
        return attention[:, 0]
