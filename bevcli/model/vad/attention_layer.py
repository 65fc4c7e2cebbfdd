"""The attention layer of VAD's interactions: queries attend to keys that have positions of their own."""

from collections.abc import Iterator
from contextlib import contextmanager

from torch import Tensor, nn

from bevcli.model.feed_forward import FeedForward


class AttentionLayer(nn.Module):
    """Attention and a feed-forward network, each with a residual and a norm. Positions are not in the residual."""

    def __init__(self, channels: int, heads: int, feed_forward_width: int, dropout: float) -> None:
        super().__init__()
        self.attention = nn.MultiheadAttention(channels, heads, dropout, batch_first=True)
        self.feed_forward = FeedForward(channels, feed_forward_width, dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(2))
        self.dropout = nn.Dropout(dropout)

    def forward(
        self, query: Tensor, query_position: Tensor, value: Tensor, key_position: Tensor, masked: Tensor | None = None
    ) -> Tensor:
        """The refined queries (B, Q, C).

        Args:
            query: (B, Q, C).
            query_position: (B, Q or 1, C), position embedding of the queries.
            value: (B, K, C), attended to.
            key_position: (B, K, C), position embedding of the values.
            masked: (B, K) bool, values that the queries of a batch element do not attend to. None for no such value.
        """
        attended, _ = self.attention(
            query + query_position, value + key_position, value, key_padding_mask=masked, need_weights=False
        )
        query = self.norms[0](query + self.dropout(attended))
        return self.norms[1](query + self.feed_forward(query))

    def weights(
        self, query: Tensor, query_position: Tensor, value: Tensor, key_position: Tensor, masked: Tensor | None = None
    ) -> Tensor:
        """The attention weights (B, Q, K) of `forward`, the mean over heads; each row sums to 1."""
        _, weights = self.attention(query + query_position, value + key_position, value, key_padding_mask=masked)
        return weights


@contextmanager
def attention_weights(*layers: AttentionLayer) -> Iterator[dict[AttentionLayer, Tensor]]:
    """A dict that is filled with the `AttentionLayer.weights` of each call inside the context; the last call stays."""
    found: dict[AttentionLayer, Tensor] = {}

    def keep(layer: AttentionLayer, arguments: tuple[Tensor, ...]) -> None:
        found[layer] = layer.weights(*arguments)

    handles = [layer.register_forward_pre_hook(keep) for layer in layers]
    try:
        yield found
    finally:
        for handle in handles:
            handle.remove()
