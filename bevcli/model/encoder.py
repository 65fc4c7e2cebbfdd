"""The BEV encoder: layers of temporal self-attention, spatial cross-attention and a feed-forward network."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class EncoderConfig:
    """temporal_points: sampling points a head and BEV map.

    spatial_points: sampling points a head and feature level, a multiple of the grid's pillar points.
    camera_embedding: whether a learned vector of its camera is added to every image feature.
    level_embeddings: learned vectors of feature levels, at least as many as the neck has levels
    (the published files of weights always hold four).
    """

    layers: int = 6
    heads: int = 8
    temporal_points: int = 4
    spatial_points: int = 8
    feed_forward_width: int = 512
    dropout: float = 0.1
    camera_embedding: bool = True
    level_embeddings: int = 4
