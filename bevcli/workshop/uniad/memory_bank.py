"""The memory bank (UniAD, Hu et al. 2023, after MOTR): each track attends to a few of its own earlier embeddings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn


@dataclass(frozen=True)
class Memories:
    """The memories of K tracks.

    Attributes:
        embeddings: (K, M, C), the newest last.
        is_empty: (K, M) bool, slots without an embedding.
        wait: (K,) int64 number of frames until the next embedding is saved; 0 saves in this frame.
    """

    embeddings: Tensor
    is_empty: Tensor
    wait: Tensor

    def each(self, change: Callable[[Tensor], Tensor]) -> Memories:
        """The memories after a change of every tensor."""
        return Memories(change(self.embeddings), change(self.is_empty), change(self.wait))

    def __getitem__(self, selection: Tensor) -> Memories:
        """The memories of a mask (K,) bool."""
        return self.each(lambda column: column[selection])

    @staticmethod
    def empty(like: Tensor, length: int) -> Memories:
        """The memories of K new tracks. like: (K, C), embeddings of the tracks. length: M."""
        count, channels = like.shape
        return Memories(
            like.new_zeros(count, length, channels),
            torch.ones(count, length, dtype=torch.bool, device=like.device),
            torch.zeros(count, dtype=torch.int64, device=like.device),
        )

    def followed_by(self, others: Memories) -> Memories:
        """These memories, then the others."""
        columns = zip(vars(self).values(), vars(others).values(), strict=True)
        return Memories(*map(torch.cat, columns))


class MemoryBank(nn.Module):
    """Attention of tracks to their memories, and the saving of new ones."""

    def __init__(self, channels: int, heads: int, interval: int) -> None:
        super().__init__()
        self.interval = interval
        self.attention = nn.MultiheadAttention(channels, heads, batch_first=True)
        self.expand = nn.Linear(channels, channels)
        self.reduce = nn.Linear(channels, channels)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(2))
        self.save_projection = nn.Linear(channels, channels)

    def forward(self, embedding: Tensor, memories: Memories) -> tuple[Tensor, Memories]:
        """embedding: (K, C) of the decoder -> the embedding (K, C) after the attention, and the memories after it."""
        remembers = ~memories.is_empty[:, -1]
        if remembers.any():
            attended = self._attend(embedding[remembers], memories[remembers])
            embedding = embedding.masked_scatter(remembers[:, None], attended)
        return embedding, self._saved(embedding, memories)

    def _attend(self, embedding: Tensor, memories: Memories) -> Tensor:
        slots = memories.embeddings
        attended, _ = self.attention(
            embedding[:, None], slots, slots, key_padding_mask=memories.is_empty, need_weights=False
        )
        embedding = self.norms[0](embedding + attended[:, 0])
        return self.norms[1](embedding + self.reduce(F.relu(self.expand(embedding))))

    def _saved(self, embedding: Tensor, memories: Memories) -> Memories:
        saves = memories.wait == 0
        newest = self.save_projection(embedding)[:, None]
        shifted = torch.cat([memories.embeddings[:, 1:], newest], dim=1)
        shifted_empty = torch.cat([memories.is_empty[:, 1:], torch.zeros_like(memories.is_empty[:, :1])], dim=1)
        return Memories(
            torch.where(saves[:, None, None], shifted, memories.embeddings),
            torch.where(saves[:, None], shifted_empty, memories.is_empty),
            torch.where(saves, self.interval - 1, memories.wait - 1),
        )
