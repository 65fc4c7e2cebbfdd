"""The segmentation head (paper, section 3.5, after Panoptic SegFormer, Li et al. 2022): BEV map to masks."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bevcli.model.decoder import DecoderConfig
from bevcli.model.location_decoder import LocationDecoder
from bevcli.model.mask_decoder import MaskDecoderLayer

# Stuff has one query a class, bound to it. Things share their queries, which training matches to instances.
STUFF_CLASSES = ("drivable_road", "lane_boundary", "pedestrian_crossing")
THING_CLASS = "vehicle"


@dataclass(frozen=True)
class SegmentationConfig:
    """thing_queries: as many vehicles at most. location_layers, mask_layers: of the two decoders.

    points: sampling points a head of the location decoder. map_scale: cells of the map along a side of a BEV cell.
    min_stuff, min_thing: how probable a class, a vehicle must be in a cell of the map.
    """

    thing_queries: int = 60
    location_layers: int = 2
    mask_layers: int = 3
    attention_heads: int = 8
    points: int = 4
    feed_forward_width: int = 512
    dropout: float = 0.1
    map_scale: int = 4
    min_stuff: float = 0.45
    min_thing: float = 0.2

    def __post_init__(self) -> None:
        if min(self.mask_layers, self.map_scale) < 1:
            raise ValueError("mask_layers and map_scale must be positive")
        if not (0 <= self.min_stuff <= 1 and 0 <= self.min_thing <= 1):
            raise ValueError("min_stuff and min_thing must be from 0 to 1")
        self.location_decoder()  # which checks the other numbers

    def location_decoder(self) -> DecoderConfig:
        """The location decoder in the object decoder's terms."""
        return DecoderConfig(
            layers=self.location_layers,
            attention_heads=self.attention_heads,
            points=self.points,
            queries=self.thing_queries,
            feed_forward_width=self.feed_forward_width,
            dropout=self.dropout,
        )


@dataclass(frozen=True)
class SegmentationOutputs:
    """Q = stuff classes, in the order of STUFF_CLASSES, then T thing queries; M mask layers, L location layers.

    mask_logits: (M, B, Q, Y·X), cell index row * columns + column.
    class_logits: (M, B, Q), that there is anything of the query's class to show.
    locations: (L, B, T, 4) of the things: centre x, y, extent x, y, 0 to 1 over the map.
    """

    mask_logits: Tensor
    class_logits: Tensor
    locations: Tensor


class SegmentationHead(nn.Module):
    """Class-fixed stuff queries and located thing queries through one mask decoder."""

    def __init__(self, config: SegmentationConfig, channels: int, bev_shape: tuple[int, int]) -> None:
        super().__init__()
        self.stuff_queries = nn.Parameter(torch.randn(len(STUFF_CLASSES), channels))
        self.location_decoder = LocationDecoder(config.location_decoder(), channels, bev_shape)
        self.mask_layers = nn.ModuleList(
            MaskDecoderLayer(channels, config.attention_heads, config.feed_forward_width, config.dropout)
            for _ in range(config.mask_layers)
        )

    def forward(self, bev: Tensor, position: Tensor) -> SegmentationOutputs:
        """bev: (B, Y·X, C). position: (Y·X, C), the cells' position code."""
        things, locations = self.location_decoder(bev)
        query = torch.cat([self.stuff_queries.expand(len(bev), -1, -1), things], dim=1)  # (B, Q, C)
        mask_logits, class_logits = [], []
        for layer in self.mask_layers:
            query, masks, classes = layer(query, position, bev)
            mask_logits.append(masks)
            class_logits.append(classes)
        return SegmentationOutputs(torch.stack(mask_logits), torch.stack(class_logits), locations)
