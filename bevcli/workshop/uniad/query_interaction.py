"""Query interaction (UniAD, after MOTR, Zeng et al. 2022): tracks update their queries for the next frame."""

import torch.nn.functional as F
from torch import Tensor, nn


class QueryInteraction(nn.Module):
    """Self-attention among the tracks; position and content of their queries take up the result."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.self_attention = nn.MultiheadAttention(channels, heads, batch_first=True)
        self.feed_forward = ResidualBlock(channels)
        self.norm = nn.LayerNorm(channels)
        self.position = ResidualBlock(channels)
        self.content = ResidualBlock(channels)

    def forward(self, embedding: Tensor, position: Tensor, content: Tensor) -> tuple[Tensor, Tensor]:
        """Position (K, C) and content (K, C) of the queries for the next frame.

        Args:
            embedding: (K, C) of the tracks, after the memory bank; K is at least 1.
            position: (K, C) first half of their queries in this frame.
            content: (K, C) second half.
        """
        key = (embedding + position)[None]
        attended, _ = self.self_attention(key, key, embedding[None], need_weights=False)
        embedding = self.norm(embedding + attended[0])
        embedding = self.feed_forward(embedding, embedding)
        return self.position(position, embedding), self.content(content, embedding)


class ResidualBlock(nn.Module):
    """A query plus a two-layer network of an embedding, normalised."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.expand = nn.Linear(channels, channels)
        self.reduce = nn.Linear(channels, channels)
        self.norm = nn.LayerNorm(channels)

    def forward(self, query: Tensor, embedding: Tensor) -> Tensor:
        """query, embedding: (K, C) -> (K, C)."""
        return self.norm(query + self.reduce(F.relu(self.expand(embedding))))
