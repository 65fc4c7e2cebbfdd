"""AttentionProbe: asks a forward pass what the attentions of one encoder layer looked at."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class SpatialSamples:
    """What K' (camera, cell) pairs sampled in spatial cross-attention.

    camera: (K',) index in B·N. cell: (K',) index in B·Y·X.
    locations: (K', heads, L, P, 2) x, y, 0 to 1 over the padded image. weights: (K', heads, L, P), of sum 1 a head.
    """

    camera: Tensor
    cell: Tensor
    locations: Tensor
    weights: Tensor


@dataclass
class AttentionProbe:
    """Goes into `BEVFormer.forward` with a question and comes back with the answers filled in.

    layer: the encoder layer asked, from 0. cells: (K,) int64, the cells (index in B·Y·X) whose samples to keep.
    spatial: the answer of spatial cross-attention.
    history_share: (B, Y·X) the answer of temporal self-attention: how much of what a cell sampled came from the
    history map, by length of the two sampled vectors, 0 to 1; None without history. (The attention weights
    themselves cannot tell: their softmax is taken for each map alone, and the two maps are averaged.)
    """

    layer: int
    cells: Tensor
    spatial: SpatialSamples | None = None
    history_share: Tensor | None = None
