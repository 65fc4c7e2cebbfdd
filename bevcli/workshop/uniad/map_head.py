"""The panoptic map head of UniAD (Hu et al. 2023): a BEV map to lane lines and drivable area.

After Panoptic SegFormer (Li et al. 2022): an encoder refines the BEV map, a location decoder finds things, and two mask
decoders paint the masks of things and of stuff.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from bevcli.frame import MOST_MAP_CLASSES, BevMap
from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.decoder import DecoderConfig, best_classes
from bevcli.model.deformable_attention import DeformableAttention, LevelShapes, sampling_locations
from bevcli.model.encoder import FeedForward, normalized_centers
from bevcli.model.segmentation import LocationDecoder, map_of_layers, split_heads
from bevcli.parsing.documents import Count, ShareBelowOne

NORM_EPS = 1e-6
TEMPERATURE = 10_000.0  # of the sine position embedding
QUERIES_AT_ONCE = 20  # the attention maps of all queries together would need hundreds of megabytes


@dataclass(frozen=True)
class MapHeadConfig:
    """The map head. The defaults are those of the published weights."""

    stuff: tuple[str, ...] = ("drivable_area",)  # classes with one mask each
    things: tuple[str, ...] = ("divider", "pedestrian_crossing", "contour")  # in the order of the logits
    thing_queries: Count = 300  # T, the number of thing queries
    max_things: Count = 100  # K, the number of pairs of a query and a class that get a mask, those with the best scores
    encoder_layers: Count = 6  # layers of the encoder
    location_layers: Count = 6  # layers of the location decoder
    thing_mask_layers: Count = 4  # layers of the mask decoder of things
    stuff_mask_layers: Count = 6  # layers of the mask decoder of stuff
    attention_heads: Count = 8  # heads of all attentions
    points: Count = 4  # sampling points of a head of the deformable attentions
    # feature levels that the deformable attentions are built for. The map head has one map, so 1 is plain deformable
    # attention. The published weights were trained with 4, where `FlatListAttention` reads offsets and weights in
    # another order
    attention_levels: Count = 4
    feed_forward_width: Count = 512  # channels inside the feed-forward networks of encoder and location decoder
    mask_feed_forward_width: Count = 1024  # channels inside the feed-forward networks of the mask decoders
    dropout: ShareBelowOne = 0.1  # probability in encoder and location decoder
    min_mask: float = 0.5  # value of a mask above which a cell belongs to it
    min_score: float = 0.1  # things with a lower score are left out
    max_overlap: float = 0.4  # a thing is left out if a larger share of its cells belongs to things with better scores
    thing_offset_m: tuple[float, float] = (0.0, -0.94)  # added to cells of things (see docs/bevformer.md)

    def __post_init__(self) -> None:
        count = len(self.classes)
        if not (self.stuff and self.things) or len(set(self.classes)) < count or count > MOST_MAP_CLASSES:
            raise ValueError(
                f"stuff and things need at least one class each, together at most {MOST_MAP_CLASSES}, and none twice"
            )
        if self.max_things > self.thing_queries * len(self.things):
            raise ValueError("max_things must be at most the number of pairs of a query and a class")

    @property
    def classes(self) -> tuple[str, ...]:
        """All classes of the map: stuff, then things."""
        return (*self.stuff, *self.things)

    def transformer(self, layers: int) -> DecoderConfig:
        """Encoder or location decoder, whose layers are those of the object decoder."""
        return DecoderConfig.of_head(self, layers, self.thing_queries)


@dataclass(frozen=True)
class MapOutputs:
    """Thing queries, and the masks of the K selected things and of stuff.

    A query is selected once for each of its classes that is among the best scores.
    """

    class_logits: Tensor  # (B, T, things) of the last layer of the location decoder
    locations: Tensor  # (L, B, T, 4) of all location layers: centre x, y and extent x, y, 0 to 1 over the map
    queries: Tensor  # (B, K) int64, the thing query of each selected thing, by falling score
    labels: Tensor  # (B, K) int64, its class, an index into `MapHeadConfig.things`
    scores: Tensor  # (B, K), its class score, 0 to 1
    thing_masks: Tensor  # (B, K, Y·X), 0 or larger, without an upper limit; cells as in the BEV map
    stuff_masks: Tensor  # (B, S, Y·X), the same for the S stuff classes


class MapHead(nn.Module):
    """Encoder, location decoder, and the mask decoders of things and stuff."""

    def __init__(self, config: MapHeadConfig, channels: int, grid: BevGrid) -> None:
        super().__init__()
        self.max_things = config.max_things
        levels, heads, width = config.attention_levels, config.attention_heads, config.mask_feed_forward_width
        self.encoder = MapEncoder(config.transformer(config.encoder_layers), channels, grid, levels)
        self.location_decoder = LocationDecoder(
            config.transformer(config.location_layers),
            channels,
            (grid.rows, grid.columns),
            branch_layers=3,
            refines_extent=True,
            attention=FlatListAttention,
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
        scores, queries, labels = best_classes(class_logits, self.max_things)
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


class FlatListAttention(DeformableAttention):
    """Deformable attention to one map by a module that was built for several levels, as UniAD's weights were trained.

    It reads locations and weights as the CUDA kernel of the released code does: it takes the flat list of all
    (query, head, level) for a list of the map's L levels. Query n then gets the heads · L entries from n · heads · L
    on. They were predicted by query n · L / (predicted levels), rounded down, and lie around that query's reference
    point. Their weights are not normalised again.
    """

    def attend(self, query: Tensor, reference_points: Tensor, tokens: Tensor, level_shapes: LevelShapes) -> Tensor:
        """See `DeformableAttention`.

        reference_points: (B, Q, 2), or (B, Q, 4) with the extent along x and y: then offsets are measured in half
        extents, divided by the number of points.
        """
        (heads, _, predicted, points), levels, (batch, queries, _) = self.shape, len(level_shapes), query.shape
        read = -(-queries * levels // predicted)  # the queries whose offsets and weights are used
        offsets, logits = self.predict(query[:, :read])  # (B, read, heads, 1, predicted, P, 2)
        offsets, reference = offsets[:, :, :, 0], reference_points[:, :read, None, None, None]
        if reference_points.shape[-1] == 2:
            locations = sampling_locations(reference, offsets, self.sampling.level_sizes(level_shapes, offsets.device))
        else:
            locations = reference[..., :2] + offsets / points * reference[..., 2:] * 0.5
        locations = locations.flatten(1, 3).unflatten(1, (-1, heads, levels))  # (B, Q or more, heads, L, P, 2)
        weights = self.sampling.weights(logits).flatten(1, 4).unflatten(1, (-1, heads, levels))
        samples = locations[:, :queries].flatten(0, 1), weights[:, :queries].flatten(0, 1), [queries] * batch
        sampled = self.sampling(self.values(tokens), level_shapes, *samples)
        attended: Tensor = self.output_projection(sampled.unflatten(0, (batch, queries)))
        return attended


class MapEncoder(nn.Module):
    """Refines the BEV map for the map head. Its result has the shape of the BEV map."""

    position: Tensor  # (Y·X, C) float32, sine position embedding of the cells
    cell_centers: Tensor  # (Y·X, 2) float32, x and y of the cells' centres, 0 to 1 over the map

    def __init__(self, config: DecoderConfig, channels: int, grid: BevGrid, attention_levels: int) -> None:
        """Random weights. attention_levels: levels that the attentions are built for, although there is one map."""
        super().__init__()
        shape = (grid.rows, grid.columns)
        self.layers = nn.ModuleList(
            MapEncoderLayer(config, channels, shape, attention_levels) for _ in range(config.layers)
        )
        self.level_embedding = nn.Parameter(torch.randn(attention_levels, channels))  # only the first row is used
        self.register_buffer("position", sine_position(*shape, channels), persistent=False)
        self.register_buffer("cell_centers", normalized_centers(grid), persistent=False)

    def forward(self, bev: Tensor) -> Tensor:
        """bev: (B, Y·X, C) -> (B, Y·X, C)."""
        position = self.position + self.level_embedding[0]
        centers = self.cell_centers.expand(len(bev), -1, -1)
        for layer in self.layers:
            bev = layer(bev, position, centers)
        return bev


class MapEncoderLayer(nn.Module):
    """Deformable self-attention and feed-forward network, each with a residual and a norm."""

    def __init__(self, config: DecoderConfig, channels: int, bev_shape: tuple[int, int], attention_levels: int) -> None:
        super().__init__()
        self.level_shapes: LevelShapes = (bev_shape,)
        heads, points = config.attention_heads, config.points
        self.self_attention = FlatListAttention(channels, channels, heads, points, attention_levels)
        self.feed_forward = FeedForward(channels, config.feed_forward_width, config.dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(2))
        self.dropout = nn.Dropout(config.dropout)

    def forward(self, cells: Tensor, position: Tensor, centers: Tensor) -> Tensor:
        """The refined cells (B, Y·X, C).

        cells: (B, Y·X, C). position: (Y·X, C), their embedding. centers: (B, Y·X, 2) x, y, 0 to 1 over the map.
        """
        attended = self.self_attention.attend(cells + position, centers, cells, self.level_shapes)
        cells = self.norms[0](cells + self.dropout(attended))
        return self.norms[1](cells + self.feed_forward(cells))


def sine_position(rows: int, columns: int, channels: int) -> Tensor:
    """(rows · columns, channels) sine position embedding: first that of the row (y), then that of the column (x).

    Of each, sine (even channels) and cosine (odd ones) of the cell's centre at falling frequencies.
    """
    half, channel = channels // 2, torch.arange(channels // 2)
    embeddings = []
    for cells in (rows, columns):
        centers = (torch.arange(cells, dtype=torch.float32) + 0.5) / (cells + 1e-6) * (2 * math.pi)
        angles = centers[:, None] / TEMPERATURE ** (2 * (channel // 2) / half)
        embeddings.append(torch.where(channel % 2 == 0, angles.sin(), angles.cos()))
    y, x = embeddings
    return torch.cat([y[:, None].expand(-1, columns, -1), x.expand(rows, -1, -1)], dim=-1).flatten(0, 1)


class MaskDecoder(nn.Module):
    """Layers of attention to the cells, and a mask for each query."""

    def __init__(self, channels: int, heads: int, layers: int, width: int, *, self_attention: bool) -> None:
        """Random weights. With self_attention, the queries of a layer attend to each other first.

        width: channels between the two linear layers of a feed-forward network.
        """
        super().__init__()
        self.layers = nn.ModuleList(MaskLayer(channels, heads, width, self_attention) for _ in range(layers))
        self.masks = MaskProjection(channels, heads)

    def forward(self, query: Tensor, cells: Tensor, position: Tensor | None = None) -> Tensor:
        """The masks (B, Q, Y·X), 0 or larger, without an upper limit. A mask has the cells above 0.5.

        Args:
            query: (B, Q, C).
            cells: (B, Y·X, C).
            position: (Q, C), added to the queries before each layer and before the masks; None for none.
        """
        for layer in self.layers:
            query = layer(query if position is None else query + position, cells)
        return self.masks(query if position is None else query + position, cells)


class MaskLayer(nn.Module):
    """Self-attention (where there is one), attention to all cells, and feed-forward network, with norms."""

    def __init__(self, channels: int, heads: int, width: int, self_attention: bool) -> None:
        super().__init__()
        self.heads = heads
        self.self_attention = nn.MultiheadAttention(channels, heads, batch_first=True) if self_attention else None
        self.self_attention_norm = nn.LayerNorm(channels, NORM_EPS) if self_attention else None
        self.query_projection = nn.Linear(channels, channels)
        self.key_projection = nn.Linear(channels, channels)
        self.value_projection = nn.Linear(channels, channels)
        self.output_projection = nn.Linear(channels, channels)
        self.feed_forward = FeedForward(channels, width, dropout=0.0, activation="gelu")
        self.norms = nn.ModuleList(nn.LayerNorm(channels, NORM_EPS) for _ in range(2))

    def forward(self, query: Tensor, cells: Tensor) -> Tensor:
        """query: (B, Q, C), cells: (B, Y·X, C) -> refined queries (B, Q, C)."""
        if self.self_attention is not None and self.self_attention_norm is not None:
            attended, _ = self.self_attention(query, query, query, need_weights=False)
            query = self.self_attention_norm(query + attended)
        queries = split_heads(self.query_projection(query), self.heads)
        keys, values = (split_heads(layer(cells), self.heads) for layer in (self.key_projection, self.value_projection))
        attended = F.scaled_dot_product_attention(queries, keys, values)  # (B, heads, Q, C / heads)
        query = self.norms[0](query + self.output_projection(attended.transpose(1, 2).flatten(2)))
        return self.norms[1](query + self.feed_forward(query))


class MaskProjection(nn.Module):
    """Masks from the attention of the queries to the cells: two layers of ReLU over the heads."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query_projection = nn.Linear(channels, channels)
        self.key_projection = nn.Linear(channels, channels)
        self.hidden = nn.Linear(heads, heads)
        self.output = nn.Linear(heads, 1)

    def forward(self, query: Tensor, cells: Tensor) -> Tensor:
        """query: (B, Q, C), cells: (B, Y·X, C) -> masks (B, Q, Y·X), 0 or larger."""
        queries = split_heads(self.query_projection(query), self.heads)
        keys = split_heads(self.key_projection(cells), self.heads).transpose(-1, -2)  # (B, heads, C / heads, Y·X)
        masks = []
        for chunk in queries.split(QUERIES_AT_ONCE, dim=2):
            attention = chunk @ keys / math.sqrt(chunk.shape[-1])  # (B, heads, q, Y·X)
            for layer in (self.hidden, self.output):
                attention = torch.einsum("gh,bhqs->bgqs", layer.weight, attention) + layer.bias[:, None, None]
                attention = attention.relu_()
            masks.append(attention[:, 0])
        return torch.cat(masks, dim=1)


@dataclass(frozen=True)
class MergedMap:
    """The classes and the instances of every cell of the BEV grid; rows from the smallest y."""

    stuff: NDArray[np.bool_]  # (S, rows, columns) bool, in the order of `MapHeadConfig.stuff`
    things: NDArray[np.bool_]  # (classes, rows, columns), as `MapHeadConfig.things`; a cell may have several classes
    instances: NDArray[np.int64]  # (rows, columns) int64, the number of a cell's instance from 1, 0 for none
    instance_labels: tuple[int, ...]  # class of each instance, an index into `MapHeadConfig.things`, by falling score
    instance_scores: tuple[float, ...]  # score of each instance, 0 or larger

    def bev_map(self, grid: BevGrid, config: MapHeadConfig) -> BevMap:
        """The classes without instances, rows from the largest y.

        Things are moved by `config.thing_offset_m`, rounded to whole cells; cells that leave the grid are lost.

        grid: gives the ranges that the map covers. config: of the map head.
        """
        (x, y), (size_x, size_y) = config.thing_offset_m, grid.cell_size_m
        things = _moved(self.things, rows=round(y / size_y), columns=round(x / size_x))
        return map_of_layers([*self.stuff, *things], config.classes, grid)


def merge_map(outputs: MapOutputs, config: MapHeadConfig, grid: BevGrid) -> MergedMap:
    """The map of a batch of one.

    A cell has a stuff class where its mask is larger than `config.min_mask`. Things are written by falling score, with
    the rules of the released code: see `_merge_things`.
    """
    columns = (outputs.thing_masks, outputs.stuff_masks, outputs.scores)
    masks, stuff, scores = (column[0].detach().float() for column in columns)
    labels, shape = outputs.labels[0], (grid.rows, grid.columns)
    scores, order = thing_scores(masks, scores, config.min_mask).sort(descending=True)
    order = order[scores >= config.min_score]
    cells = (masks[order] > config.min_mask).unflatten(-1, shape).cpu().numpy()
    things, instances, kept = _merge_things(cells, labels[order].tolist(), config)
    return MergedMap(
        stuff=(stuff > config.min_mask).unflatten(-1, shape).cpu().numpy(),
        things=things,
        instances=instances,
        instance_labels=tuple(labels[order][kept].tolist()),
        instance_scores=tuple(scores[kept].tolist()),
    )


def thing_scores(masks: Tensor, scores: Tensor, min_mask: float) -> Tensor:
    """Class score times the square of the mask's mean over its cells: (K,), 0 or larger.

    The mean's denominator is the number of cells plus 1, so that an empty mask scores 0.
    masks: (K, Y·X). scores: (K,) class scores. min_mask: a cell belongs to a mask where this is larger.
    """
    inside = masks > min_mask
    mean = (masks * inside).sum(-1) / (inside.sum(-1) + 1)
    return scores * mean**2


def _merge_things(
    masks: NDArray[np.bool_], labels: list[int], config: MapHeadConfig
) -> tuple[NDArray[np.bool_], NDArray[np.int64], list[int]]:
    """Writes things over each other, those with better scores first.

    A thing is left out if more than `config.max_overlap` of its cells are taken; else it gets those that are not taken.
    As in the released code, things of the first class (dividers) take no cells: others may be written over them.

    masks: (K, rows, columns). labels: K classes, indices into `config.things`. Returns the cells of each class
    (classes, rows, columns); the number of the instance from 1, 0 for none (rows, columns); and the indices of the
    things that are instances, in the order of their numbers.
    """
    layers = np.zeros((len(config.things), *masks.shape[1:]), dtype=bool)
    instances = np.zeros(masks.shape[1:], dtype=np.int64)
    taken = np.zeros(masks.shape[1:], dtype=bool)
    kept: list[int] = []
    for index, (mask, label) in enumerate(zip(masks, labels, strict=True)):
        count = int(mask.sum())
        if count == 0 or int((mask & taken).sum()) / count > config.max_overlap:
            continue
        free = mask & ~taken
        kept.append(index)
        layers[label] |= free
        instances[free] = len(kept)
        taken[free] = label > 0
    return layers, instances, kept


def _moved(layers: NDArray[np.bool_], rows: int, columns: int) -> NDArray[np.bool_]:
    """Layers (K, Y, X), moved by whole cells; what leaves the grid is lost."""
    _, height, width = layers.shape
    y, x = abs(rows), abs(columns)
    padded = np.pad(layers, ((0, 0), (y, y), (x, x)))
    return padded[:, y - rows : y - rows + height, x - columns : x - columns + width]
