"""What is constant in a BEVFormerV2, computed before the first frame.

No ego-motion enters its BEV queries, and they take the place of the history.
"""

import torch
from torch import Tensor, nn

from bevcli.model.bev_queries import BevQueries
from bevcli.model.deformable_attention import DeformableAttention
from bevcli.model.encoder import Encoder, TemporalSelfAttention


class ConstantTemporalSelfAttention(nn.Module):
    """Takes the place of the first encoder layer's temporal self-attention, whose input is the same in every frame."""

    attended: Tensor

    def __init__(self, encoder: Encoder, bev_queries: BevQueries) -> None:
        super().__init__()
        first = encoder.layers[0].get_submodule("temporal_self_attention")
        assert isinstance(first, TemporalSelfAttention)
        self.attention = first.attention  # for observers of the encoder
        queries = bev_queries.embedding[None]
        with torch.no_grad():
            attended = first(queries, bev_queries.position(), queries[:, None], encoder.reference_points(None))
        self.register_buffer("attended", attended, persistent=False)  # (1, Y·X, C)

    def forward(self, query: Tensor, position: Tensor, bev_maps: Tensor, reference_points: Tensor) -> Tensor:
        """Arguments as for `TemporalSelfAttention`, of which only the shape of the query is read -> (B, Y·X, C)."""
        return self.attended.expand_as(query)


class OwnQueriesAttention(nn.Module):
    """Takes the place of a temporal self-attention that never has a history: both maps are the queries.

    Offsets and weights are a linear function of (query, query + position). The products with the query are added up
    beforehand, and those with the position computed.
    """

    constant: Tensor

    def __init__(self, plain: TemporalSelfAttention, position: Tensor) -> None:
        """position: (Y·X, C), position embedding of the cells."""
        super().__init__()
        self.plain = plain
        layers = (plain.attention.sampling_offsets, plain.attention.attention_weights)
        of_history, of_query = torch.cat([layer.weight for layer in layers]).chunk(2, dim=1)
        bias = torch.cat([layer.bias for layer in layers])
        self.sizes = [layer.out_features for layer in layers]
        self.both = nn.Linear(of_query.shape[1], of_query.shape[0], bias=False, device="meta")
        self.both.weight = nn.Parameter(of_history + of_query, requires_grad=False)
        self.register_buffer("constant", position @ of_query.T + bias, persistent=False)  # (Y·X, both sizes)

    @property
    def attention(self) -> DeformableAttention:
        """The deformable attention, for observers of the encoder."""
        return self.plain.attention

    def forward(self, query: Tensor, position: Tensor, bev_maps: Tensor, reference_points: Tensor) -> Tensor:
        """As `TemporalSelfAttention.forward`; the position is not read."""
        offsets, logits = (self.both(query) + self.constant).split(self.sizes, dim=-1)
        shape = self.plain.attention.shape
        offsets, logits = offsets.float().unflatten(-1, (*shape, 2)), logits.unflatten(-1, shape)
        return self.plain.sample(bev_maps, reference_points, offsets, logits)
