"""The mask decoder of the segmentation head: a query's attention to the cells is its mask (Panoptic SegFormer)."""

from __future__ import annotations

import math

from torch import Tensor, nn

from bevcli.model.feed_forward import FeedForward


class MaskDecoderLayer(nn.Module):
    """Queries attend to every cell of the BEV map, in several heads; the heads' maps together make the masks."""

    def __init__(self, channels: int, heads: int, feed_forward_width: int, dropout: float) -> None:
        super().__init__()
        self.heads = heads
        self.query_projection = nn.Linear(channels, channels)
        self.key_projection = nn.Linear(channels, channels)
        self.value_projection = nn.Linear(channels, channels)
        self.output_projection = nn.Linear(channels, channels)
        # A 1x1 convolution over the heads' attention maps.
        self.mask_projection = nn.Linear(heads, 1)
        self.class_branch = nn.Linear(channels, 1)
        self.feed_forward = FeedForward(channels, feed_forward_width, dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(2))
        self.dropout = nn.Dropout(dropout)
        nn.init.constant_(self.class_branch.bias, -math.log(99))  # focal prior, as in the detection head

    def forward(self, query: Tensor, position: Tensor, bev: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """query: (B, Q, C). position: (Y·X, C), the cells' position code. bev: (B, Y·X, C).

        Returns refined queries (B, Q, C), mask logits (B, Q, Y·X) and class logits (B, Q).
        """
        queries = self._split(self.query_projection(query))
        keys = self._split(self.key_projection(bev + position))
        values = self._split(self.value_projection(bev))  # (B, heads, Y·X, C / heads)
        attention = queries @ keys.transpose(-1, -2) / math.sqrt(keys.shape[-1])  # (B, heads, Q, Y·X)
        mask_logits = self.mask_projection(attention.movedim(1, -1)).squeeze(-1)  # (B, Q, Y·X)
        attended = (attention.softmax(-1) @ values).transpose(1, 2).flatten(2)  # (B, Q, C)
        query = self.norms[0](query + self.dropout(self.output_projection(attended)))
        query = self.norms[1](query + self.feed_forward(query))
        return query, mask_logits, self.class_branch(query).squeeze(-1)

    def _split(self, tokens: Tensor) -> Tensor:
        """(B, S, C) -> (B, heads, S, C / heads)."""
        return tokens.unflatten(-1, (self.heads, -1)).transpose(1, 2)
