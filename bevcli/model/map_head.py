"""The panoptic map head of UniAD (Hu et al. 2023): a BEV map to lane lines and drivable area.

After Panoptic SegFormer (Li et al. 2022): an encoder refines the BEV map, a location decoder finds things, and two mask
decoders paint the masks of things and of stuff.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bevcli.frame import MOST_MAP_CLASSES
from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.decoder import DecoderConfig
from bevcli.model.map_encoder import MapEncoder
from bevcli.model.map_masks import MaskDecoder
from bevcli.model.segmentation import LocationDecoder


@dataclass(frozen=True)
class MapHeadConfig:
    """The map head. The defaults are those of the published weights.

    Attributes:
        stuff: classes with one mask each.
        things: classes of instances, in the order of the class logits.
        thing_queries: T, the number of thing queries.
        max_things: K, the number of pairs of a query and a class that get a mask, those with the best scores.
        encoder_layers: layers of the encoder.
        location_layers: layers of the location decoder.
        thing_mask_layers: layers of the mask decoder of things.
        stuff_mask_layers: layers of the mask decoder of stuff.
        attention_heads: heads of all attentions.
        points: sampling points of a head of the deformable attentions.
        attention_levels: feature levels that the deformable attentions are built for. The map head has one map, so 1
            is plain deformable attention. The published weights were trained with 4, where `DeformableAttention.attend`
            reads offsets and weights in another order.
        feed_forward_width: channels inside the feed-forward networks of encoder and location decoder.
        mask_feed_forward_width: channels inside the feed-forward networks of the mask decoders.
        dropout: probability in encoder and location decoder, 0 to below 1.
        min_mask: value of a mask above which a cell belongs to it.
        min_score: things with a lower score are left out.
        max_overlap: a thing is left out if a larger share of its cells belongs to things with better scores.
        thing_offset_m: x, y in metres, bev frame, added to the cells of things: the published weights were trained with
            lines around the ego origin and drivable area around the lidar, which is 0.94 m further ahead.
    """

    stuff: tuple[str, ...] = ("drivable_area",)
    things: tuple[str, ...] = ("divider", "pedestrian_crossing", "contour")
    thing_queries: int = 300
    max_things: int = 100
    encoder_layers: int = 6
    location_layers: int = 6
    thing_mask_layers: int = 4
    stuff_mask_layers: int = 6
    attention_heads: int = 8
    points: int = 4
    attention_levels: int = 4
    feed_forward_width: int = 512
    mask_feed_forward_width: int = 1024
    dropout: float = 0.1
    min_mask: float = 0.5
    min_score: float = 0.1
    max_overlap: float = 0.4
    thing_offset_m: tuple[float, float] = (0.0, -0.94)

    def __post_init__(self) -> None:
        count = len(self.classes)
        if not (self.stuff and self.things) or len(set(self.classes)) < count or count > MOST_MAP_CLASSES:
            raise ValueError(
                f"stuff and things need at least one class each, together at most {MOST_MAP_CLASSES}, and none twice"
            )
        counts = (self.thing_mask_layers, self.stuff_mask_layers, self.attention_levels, self.mask_feed_forward_width)
        if min(counts) < 1 or not 1 <= self.max_things <= self.thing_queries * len(self.things):
            raise ValueError(
                "layers, attention_levels and mask_feed_forward_width must be positive, and max_things from 1 to the "
                "number of pairs of a query and a class"
            )
        self.location_decoder()  # checks the other numbers
        self.encoder()

    @property
    def classes(self) -> tuple[str, ...]:
        """All classes of the map: stuff, then things."""
        return (*self.stuff, *self.things)

    def location_decoder(self) -> DecoderConfig:
        """The location decoder's layers, which are those of the object decoder."""
        return self._layers(self.location_layers)

    def encoder(self) -> DecoderConfig:
        """The encoder's layers."""
        return self._layers(self.encoder_layers)

    def _layers(self, count: int) -> DecoderConfig:
        return DecoderConfig(
            layers=count,
            attention_heads=self.attention_heads,
            points=self.points,
            queries=self.thing_queries,
            feed_forward_width=self.feed_forward_width,
            dropout=self.dropout,
        )


@dataclass(frozen=True)
class MapOutputs:
    """Thing queries, and the masks of the K selected things and of stuff.

    A query is selected once for each of its classes that is among the best scores.

    Attributes:
        class_logits: (B, T, things) of the last layer of the location decoder.
        locations: (L, B, T, 4) of the L location layers: centre x, y and extent x, y of the things, 0 to 1 over the
            map.
        queries: (B, K) int64, the thing query of each selected thing, by falling score.
        labels: (B, K) int64, its class, an index into `MapHeadConfig.things`.
        scores: (B, K), its class score, 0 to 1.
        thing_masks: (B, K, Y·X), 0 or larger, without an upper limit; the index of a cell is row * columns + column.
        stuff_masks: (B, S, Y·X), the same for the S stuff classes.
    """

    class_logits: Tensor
    locations: Tensor
    queries: Tensor
    labels: Tensor
    scores: Tensor
    thing_masks: Tensor
    stuff_masks: Tensor


class MapHead(nn.Module):
    """Encoder, location decoder, and the mask decoders of things and stuff."""

    def __init__(self, config: MapHeadConfig, channels: int, grid: BevGrid) -> None:
        super().__init__()
        self.max_things = config.max_things
        levels, heads, width = config.attention_levels, config.attention_heads, config.mask_feed_forward_width
        self.encoder = MapEncoder(config.encoder(), channels, grid, levels)
        self.location_decoder = LocationDecoder(
            config.location_decoder(),
            channels,
            (grid.rows, grid.columns),
            branch_layers=3,
            refines_extent=True,
            attention_levels=levels,
        )
        self.class_branch = nn.Linear(channels, len(config.things))
        # The first half of the channels is the content of a query, the second half its position.
        self.stuff_queries = nn.Parameter(torch.randn(len(config.stuff), 2 * channels))
        self.thing_masks = MaskDecoder(channels, heads, config.thing_mask_layers, width, self_attention=False)
        self.stuff_masks = MaskDecoder(channels, heads, config.stuff_mask_layers, width, self_attention=True)

    def forward(self, bev: Tensor) -> MapOutputs:
        """bev: (B, Y·X, C), before any rotation to the next frame."""
        cells = self.encoder(bev)
        things, locations = self.location_decoder(cells)
        class_logits = self.class_branch(things)
        scores, index = class_logits.sigmoid().flatten(1).topk(self.max_things)
        classes = class_logits.shape[-1]
        queries, labels = index // classes, index % classes
        selected = things.gather(1, queries[..., None].expand(-1, -1, things.shape[-1]))  # (B, K, C)
        content, position = self.stuff_queries.chunk(2, dim=-1)
        return MapOutputs(
            class_logits=class_logits,
            locations=locations,
            queries=queries,
            labels=labels,
            scores=scores,
            thing_masks=self.thing_masks(selected, cells),
            stuff_masks=self.stuff_masks(content.expand(len(bev), -1, -1), cells, position),
        )
