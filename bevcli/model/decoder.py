"""The object decoder: queries refined layer by layer on the BEV map, after Deformable DETR."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DecoderConfig:
    """queries: object queries. points: sampling points a head of the cross-attention into the BEV map."""

    layers: int = 6
    heads: int = 8
    points: int = 4
    queries: int = 900
    feed_forward_width: int = 512
    dropout: float = 0.1
    max_boxes: int = 300
