"""Map segmentation (paper, section 3.5, after Panoptic SegFormer, Li et al. 2022): BEV map to masks to a panoptic map.

The head's location decoder gives thing queries a place, and its mask decoder turns all queries into masks.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from bevcli.frame import MAP_CLASSES, BevMap, class_bits
from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.decoder import DecoderConfig, DecoderLayer, branch, inverse_sigmoid
from bevcli.model.deformable_attention import DeformableAttention
from bevcli.model.encoder import FeedForward
from bevcli.parsing.documents import Count, Share, ShareBelowOne

# Each stuff class has one query of its own. The thing class has many; training matches them to instances.
STUFF_CLASSES, THING_CLASS = tuple(MAP_CLASSES)[:-1], tuple(MAP_CLASSES)[-1]


@dataclass(frozen=True)
class SegmentationConfig:
    """The segmentation head."""

    thing_queries: Count = 60  # T, the largest number of vehicles
    location_layers: Count = 2  # layers of the location decoder
    mask_layers: Count = 3  # layers of the mask decoder
    attention_heads: Count = 8  # heads of all attentions
    points: Count = 4  # sampling points of a head in the location decoder
    feed_forward_width: Count = 512  # channels between the two linear layers of a feed-forward network
    dropout: ShareBelowOne = 0.1  # probability
    map_scale: Count = 4  # cells of the panoptic map along a side of a BEV cell
    min_stuff: Share = 0.45  # probability above which a cell of the map has a stuff class
    min_thing: Share = 0.2  # probability above which a cell of the map belongs to a vehicle


@dataclass(frozen=True)
class SegmentationOutputs:
    """Masks of Q queries: one for each of STUFF_CLASSES, in this order, then T thing queries."""

    mask_logits: Tensor  # (M, B, Q, Y·X) of the M mask layers; the index of a cell is row * columns + column
    class_logits: Tensor  # (M, B, Q), that anything of the query's class exists
    # (L, B, T, 4) of the L location layers: centre x, y and extent x, y of the things, 0 to 1 over the map
    locations: Tensor
    # see the function `map_layers`, for a batch of one; None where `decode_map` computes them
    map_layers: Tensor | None = None

    def last_layers(self) -> "SegmentationOutputs":
        """The outputs of the last layers; no masks where there are map layers, which are smaller."""
        masks = self.mask_logits[-1:] if self.map_layers is None else self.mask_logits[:0]
        return SegmentationOutputs(masks, self.class_logits[-1:], self.locations[-1:], self.map_layers)


class SegmentationHead(nn.Module):
    """Stuff queries, and thing queries from the location decoder, through one mask decoder."""

    def __init__(self, config: SegmentationConfig, channels: int, bev_shape: tuple[int, int]) -> None:
        super().__init__()
        self.stuff_queries = nn.Parameter(torch.randn(len(STUFF_CLASSES), channels))
        decoder = DecoderConfig.of_head(config, config.location_layers, config.thing_queries)
        self.location_decoder = LocationDecoder(decoder, channels, bev_shape)
        self.mask_layers = nn.ModuleList(
            MaskDecoderLayer(channels, config.attention_heads, config.feed_forward_width, config.dropout)
            for _ in range(config.mask_layers)
        )

    def forward(self, bev: Tensor, position: Tensor) -> SegmentationOutputs:
        """bev: (B, Y·X, C). position: (Y·X, C), position embedding of the cells."""
        things, locations = self.location_decoder(bev)
        query = torch.cat([self.stuff_queries.expand(len(bev), -1, -1), things], dim=1)  # (B, Q, C)
        mask_logits, class_logits = [], []
        for layer in self.mask_layers:
            query, masks, classes = layer(query, position, bev)
            mask_logits.append(masks)
            class_logits.append(classes)
        return SegmentationOutputs(torch.stack(mask_logits), torch.stack(class_logits), locations)


class LocationDecoder(nn.Module):
    """Thing queries that attend to the BEV map and predict the centre and the extent of their things.

    In the segmentation head, only the training loss uses the locations.
    """

    def __init__(
        self,
        config: DecoderConfig,
        channels: int,
        bev_shape: tuple[int, int],
        *,
        branch_layers: int = 2,
        refines_extent: bool = False,
        attention: type[DeformableAttention] = DeformableAttention,
        attention_levels: int = 1,
    ) -> None:
        """Random weights.

        Args:
            bev_shape: rows and columns of the BEV map.
            branch_layers: linear layers of a location branch.
            refines_extent: whether a layer refines centre and extent of the layer before, and samples inside them;
                otherwise it refines the centre only.
            attention, attention_levels: see `DecoderLayer`.
        """
        super().__init__()
        self.refines_extent = refines_extent
        # The first half of the channels is the position of a query, the second half its content.
        self.query_embedding = nn.Parameter(torch.randn(config.queries, 2 * channels))
        self.reference_points = nn.Linear(channels, 2)
        self.layers = nn.ModuleList(
            DecoderLayer(config, channels, bev_shape, attention, attention_levels) for _ in range(config.layers)
        )
        self.location_branches = nn.ModuleList(branch(channels, branch_layers, 4) for _ in range(config.layers))

    def forward(self, bev: Tensor) -> tuple[Tensor, Tensor]:
        """bev: (B, Y·X, C) -> thing queries (B, T, C) and locations (L, B, T, 4) of all L layers.

        A location is the centre x, y and the extent along x and y, all 0 to 1 over the map.
        """
        position, query = self.query_embedding.expand(len(bev), -1, -1).chunk(2, dim=-1)  # (B, T, C) each
        reference_points = self.reference_points(position).sigmoid()  # (B, T, 2)
        locations = []
        for layer, location_branch in zip(self.layers, self.location_branches, strict=True):
            query = layer(query, position, reference_points, bev)
            code, refined = location_branch(query), reference_points.shape[-1]
            moved = code[..., :refined] + inverse_sigmoid(reference_points)
            location = torch.cat([moved.sigmoid(), code[..., refined:].sigmoid()], dim=-1)
            locations.append(location)
            reference_points = (location if self.refines_extent else location[..., :2]).detach()
        return query, torch.stack(locations)


class MaskDecoderLayer(nn.Module):
    """Multi-head attention of queries to all cells of the BEV map; a query's mask is made of its attention maps."""

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
        nn.init.constant_(self.class_branch.bias, -math.log(99))  # prior of the focal loss, as in the detection head

    def forward(self, query: Tensor, position: Tensor, bev: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Refined queries (B, Q, C), mask logits (B, Q, Y·X) and class logits (B, Q).

        query: (B, Q, C). position: (Y·X, C), position embedding of the cells. bev: (B, Y·X, C).
        """
        queries = split_heads(self.query_projection(query), self.heads)
        keys = split_heads(self.key_projection(bev + position), self.heads)
        values = split_heads(self.value_projection(bev), self.heads)  # (B, heads, Y·X, C / heads)
        attended = self.attend(queries, keys, values).transpose(1, 2).flatten(2)  # (B, Q, C)
        # The heads' attention maps before the softmax, each times its weight: one product over all channels.
        weights = self.mask_projection.weight.flatten()[:, None, None] / math.sqrt(keys.shape[-1])  # (heads, 1, 1)
        masks = (queries * weights).transpose(1, 2).flatten(2) @ keys.transpose(1, 2).flatten(2).transpose(1, 2)
        mask_logits = masks + self.mask_projection.bias  # (B, Q, Y·X)
        query = self.norms[0](query + self.dropout(self.output_projection(attended)))
        query = self.norms[1](query + self.feed_forward(query))
        return query, mask_logits, self.class_branch(query).squeeze(-1)

    def attend(self, queries: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        """The attention of queries to keys and values, (B, heads, …, C / heads) each."""
        return F.scaled_dot_product_attention(queries, keys, values)


def split_heads(tokens: Tensor, heads: int) -> Tensor:
    """(B, S, C) -> (B, heads, S, C / heads)."""
    return tokens.unflatten(-1, (heads, -1)).transpose(1, 2)


def map_of_layers(layers: Sequence[NDArray[np.bool_]], classes: Sequence[str], grid: BevGrid) -> BevMap:
    """The map of classes with the cells (rows, columns) each, rows from the smallest y."""
    bits, cells = class_bits(classes), np.zeros(layers[0].shape, dtype=np.uint8)
    for bit, layer in zip(bits.values(), layers, strict=True):
        cells |= layer.astype(np.uint8) * np.uint8(bit)
    return BevMap(cells[::-1].copy(), grid.x_range_m, grid.y_range_m, bits)


def decode_map(outputs: SegmentationOutputs, config: SegmentationConfig, grid: BevGrid) -> BevMap:
    """The masks of the last layer, for a batch of one, merged to one map, `map_scale` times as fine as the grid.

    A cell may have several classes, such as a pedestrian crossing on a road.
    """
    layers = outputs.map_layers
    if layers is None:
        logits, of_class = (layers[-1, 0].detach().float() for layers in (outputs.mask_logits, outputs.class_logits))
        used = logits.amax(-1).sigmoid() * of_class.sigmoid() > config.min_thing  # the other things are in no cell
        used[: len(STUFF_CLASSES)] = True
        layers = map_layers(logits[used], of_class[used], config, grid)
    return map_of_layers([*layers.cpu().numpy()], (*STUFF_CLASSES, THING_CLASS), grid)


def map_layers(mask_logits: Tensor, class_logits: Tensor, config: SegmentationConfig, grid: BevGrid) -> Tensor:
    """(STUFF_CLASSES + 1, scale · rows, scale · columns) bool: the cells of each stuff class and those of vehicles.

    The probability of a query in a cell is its class probability times its mask's value (MaskFormer, Cheng et al.
    2021). Panoptic SegFormer instead takes whole masks above 0.5. Focal loss gives small vehicles mask values that
    rarely reach 0.5, and on rendered drives that rule loses a sixth of the vehicles' IoU. Between the centres of the
    grid's cells, probabilities are interpolated.

    mask_logits: (Q, Y·X) of the stuff queries and any number of thing queries. class_logits: (Q,).
    """
    probabilities = mask_logits.sigmoid() * class_logits.sigmoid()[:, None]
    coarse = probabilities.unflatten(-1, (grid.rows, grid.columns))
    fine = F.interpolate(coarse[None], scale_factor=config.map_scale, mode="bilinear", align_corners=False)[0]
    stuff, things = fine[: len(STUFF_CLASSES)], fine[len(STUFF_CLASSES) :]
    return torch.cat([stuff > config.min_stuff, (things > config.min_thing).any(0, keepdim=True)])
