"""The object decoder and its detection head, after Deformable DETR: queries that attend to the BEV map find objects.

A box code of the head is (cx, cy, log w, log l, cz, log h, sin, cos, vx, vy). As in the released code, its angle is
measured clockwise from -y: yaw = -angle - pi/2, with yaw counter-clockwise from +x.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, wrap_angle
from bevcli.model.deformable_attention import DeformableAttention
from bevcli.model.encoder import FeedForward
from bevcli.parsing.documents import Count, NotNegative, Share, ShareBelowOne

BOX_CODE_SIZE = 10
FADING_WIDTHS = 0.7  # distance from a better box, in its widths, where fading has fallen to 1/e
SUPPORT = 0.5  # share of its score that a duplicate adds to that of another box, where neither is near 1
LEAST_EXPONENT = -60.0  # what is less adds nothing, and takes a CPU up to fifty times as long


@dataclass(frozen=True)
class DecoderConfig:
    """The object decoder."""

    layers: Count = 6  # number of decoder layers
    attention_heads: Count = 8  # heads of self-attention and of cross-attention
    points: Count = 4  # sampling points of a head of the cross-attention to the BEV map
    queries: Count = 900  # number of object queries
    feed_forward_width: Count = 512  # channels between the two linear layers of the feed-forward network
    dropout: ShareBelowOne = 0.1  # probability
    max_boxes: Count = 300  # number of boxes that are decoded, those with the best scores
    # distance, in sizes of a box, within which boxes of its class count as the same object: they share their places;
    # see `merged`. With 0, as published, boxes stay where they are
    merge_duplicates: NotNegative = 0.0
    # share of its score that a box loses at the place of a better box of its class, and less beside it; see `faded`.
    # With 0, as published, scores stay as they are
    fade_duplicates: Share = 0.0
    # time in seconds in which the score of a box that no camera sees any more falls to 1/e; see
    # `bevcli.inference.box_memory`. With 0, as published, no box is remembered
    remember_s: NotNegative = 0.0
    # number of sets of queries that are trained side by side, each to find every object (Group DETR, Chen et al. 2023).
    # Inference uses the first set only
    training_groups: Count = 1

    @classmethod
    def of_head(cls, head: Any, layers: int, queries: int) -> "DecoderConfig":
        """The settings of the decoder layers in a head whose configuration has the other numbers under these names."""
        return cls(layers, head.attention_heads, head.points, queries, head.feed_forward_width, head.dropout)


@dataclass(frozen=True)
class ObjectQueries:
    """Queries as they enter the first decoder layer."""

    position: Tensor  # (B, Q, C)
    content: Tensor  # (B, Q, C)
    reference_points: Tensor  # (B, Q, 3) x, y, z, 0 to 1 over the range


class Decoder(nn.Module):
    """Object queries that attend to the BEV map and move their reference points to the objects."""

    def __init__(self, config: DecoderConfig, channels: int, bev_shape: tuple[int, int]) -> None:
        super().__init__()
        self.training_groups = config.training_groups
        # The first half of the channels is the position of a query, the second half its content.
        self.query_embedding = nn.Parameter(torch.randn(config.training_groups * config.queries, 2 * channels))
        self.reference_points = nn.Linear(channels, 3)
        self.layers = nn.ModuleList(DecoderLayer(config, channels, bev_shape) for _ in range(config.layers))
        nn.init.xavier_uniform_(self.reference_points.weight)
        nn.init.zeros_(self.reference_points.bias)

    def forward(
        self, bev: Tensor, head: "DetectionHead", queries: ObjectQueries | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Class logits (L, B, Q, classes) and box codes (L, B, Q, 10) of all L layers; the last queries (B, Q, C).

        Args:
            bev: (B, Y·X, C).
            head: class and box branches of the layers.
            queries: None takes the learned ones, in training mode those of all groups, one group after another.
        """
        groups = self.training_groups if self.training else 1
        queries = self.object_queries(len(bev), groups) if queries is None else queries
        query, reference_points = queries.content, queries.reference_points
        class_logits, box_codes = [], []
        for index, layer in enumerate(self.layers):
            query = layer(query, queries.position, reference_points[..., :2], bev, groups)
            logits, codes, refined = head(index, query, reference_points)
            class_logits.append(logits)
            box_codes.append(codes)
            reference_points = refined.detach()
        return torch.stack(class_logits), torch.stack(box_codes), query

    def fix_first_attention(self) -> None:
        """The queries attend to each other before they see the frame: computed once, in place of the first layer's."""
        self.layers[0].self_attention = ConstantSelfAttention(self.layers[0], self.object_queries(batch=1))

    def object_queries(self, batch: int, groups: int = 1) -> ObjectQueries:
        """The learned queries of the first groups, the same for each batch element."""
        count = len(self.query_embedding) // self.training_groups * groups
        position, content = self.query_embedding[:count].expand(batch, -1, -1).chunk(2, dim=-1)
        return ObjectQueries(position, content, self.reference_points(position).float().sigmoid())


class DecoderLayer(nn.Module):
    """Self-attention among the object queries, deformable cross-attention to the BEV map, feed-forward network."""

    def __init__(
        self,
        config: DecoderConfig,
        channels: int,
        bev_shape: tuple[int, int],
        attention: type[DeformableAttention] = DeformableAttention,
        attention_levels: int = 1,
    ) -> None:
        """Random weights. attention: class of the cross-attention, which has weights for so many feature levels."""
        super().__init__()
        self.level_shapes = (bev_shape,)
        heads, dropout = config.attention_heads, config.dropout
        self.self_attention = nn.MultiheadAttention(channels, heads, dropout, batch_first=True)
        self.cross_attention = attention(channels, channels, heads, config.points, attention_levels)
        self.feed_forward = FeedForward(channels, config.feed_forward_width, dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(3))
        self.dropout = nn.Dropout(dropout)
        nn.init.xavier_uniform_(self.self_attention.out_proj.weight)

    def forward(
        self, query: Tensor, position: Tensor, reference_points: Tensor, bev: Tensor, groups: int = 1
    ) -> Tensor:
        """The refined queries (B, Q, C).

        Args:
            query: (B, Q, C), contents of the queries.
            position: (B, Q, C), positions of the queries.
            reference_points: (B, Q, 2) x, y, 0 to 1 over the map, or of another `attention` also the extent.
            bev: (B, Y·X, C).
            groups: number of groups of queries; queries of different groups do not attend to each other.
        """
        value = query.unflatten(1, (groups, -1)).flatten(0, 1)  # (B · groups, Q / groups, C)
        key = value + position.unflatten(1, (groups, -1)).flatten(0, 1)
        attended, _ = self.self_attention(key, key, value, need_weights=False)
        query = self.norms[0](query + self.dropout(attended.reshape(query.shape)))
        attended = self.cross_attention.attend(query + position, reference_points, bev, self.level_shapes)
        query = self.norms[1](query + self.dropout(attended))
        return self.norms[2](query + self.feed_forward(query))


class ConstantSelfAttention(nn.Module):
    """Takes the place of the self-attention in a first decoder layer, whose input is the same in every frame."""

    attended: Tensor

    def __init__(self, first: nn.Module, queries: ObjectQueries) -> None:
        """first: a DecoderLayer. queries: those that enter it in every frame, for a batch of one."""
        super().__init__()
        assert isinstance(first, DecoderLayer)
        with torch.no_grad():
            key = queries.content + queries.position
            attended, _ = first.self_attention(key, key, queries.content, need_weights=False)
        self.register_buffer("attended", attended, persistent=False)  # (1, Q, C)

    def forward(self, query: Tensor, key: Tensor, value: Tensor, *, need_weights: bool) -> tuple[Tensor, None]:
        """query, key, value: (B, Q, C), of which only B is read -> (B, Q, C), None."""
        return self.attended.expand_as(value), None


class DetectionHead(nn.Module):
    """A class branch and a box branch for each decoder layer, with iterative box refinement."""

    range_start: Tensor
    range_extent: Tensor

    def __init__(self, layers: int, channels: int, classes: int, grid: BevGrid) -> None:
        super().__init__()
        self.class_branches = nn.ModuleList(class_branch(channels, classes) for _ in range(layers))
        self.box_branches = nn.ModuleList(branch(channels, 3, BOX_CODE_SIZE) for _ in range(layers))
        ranges = torch.tensor([grid.x_range_m, grid.y_range_m, grid.z_range_m])
        self.register_buffer("range_start", ranges[:, 0], persistent=False)
        self.register_buffer("range_extent", ranges[:, 1] - ranges[:, 0], persistent=False)

    def forward(self, layer: int, query: Tensor, reference_points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Class logits (B, Q, classes), box codes (B, Q, 10) and refined reference points (B, Q, 3) of a decoder layer.

        The centres of the boxes, in metres, are the refined reference points, 0 to 1 over the range.

        Args:
            layer: index of the decoder layer.
            query: (B, Q, C), output of that layer.
            reference_points: (B, Q, 3), input of that layer, 0 to 1 over the range.
        """
        logits = self.class_branches[layer](query)
        code = self.box_branches[layer](query).float()
        # Slices: a list of indices would be uploaded to a GPU, which waits for it.
        moved = torch.cat([code[..., :2], code[..., 4:5]], dim=-1) + inverse_sigmoid(reference_points)
        refined = moved.sigmoid()
        center = refined * self.range_extent + self.range_start
        box_codes = torch.cat([center[..., :2], code[..., 2:4], center[..., 2:], code[..., 5:]], dim=-1)
        return logits, box_codes, refined


def inverse_sigmoid(x: Tensor) -> Tensor:
    """The logit of x, which lies in 0 to 1; finite at both ends."""
    x = x.clamp(0, 1)
    return torch.log(x.clamp(min=1e-5) / (1 - x).clamp(min=1e-5))


def class_branch(channels: int, classes: int) -> nn.Sequential:
    """Linear layers with norm and ReLU between them: (..., C) -> logits (..., classes)."""
    hidden = [(nn.Linear(channels, channels), nn.LayerNorm(channels), nn.ReLU()) for _ in range(2)]
    last = nn.Linear(channels, classes)
    nn.init.constant_(last.bias, -math.log(99))  # prior of the focal loss: untrained, every class scores 0.01
    return nn.Sequential(*hidden[0], *hidden[1], last)


def best_classes(class_logits: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Scores, queries and labels, (B, K) each, of the K best pairs of a query and a class, by falling score.

    A query stands there once for each of its classes that is among the best. K is the smaller one of `count` and the
    number of pairs.

    class_logits: (B, Q, classes).
    """
    scores, classes = class_logits.sigmoid().flatten(1), class_logits.shape[-1]  # (B, Q · classes)
    best, index = scores.topk(min(count, scores.shape[1]))
    return best, index // classes, index % classes


class RegressionBranch(nn.Sequential):
    """Linear layers with ReLU between them that predict numbers such as positions and sizes."""


def branch(channels: int, layers: int, outputs: int) -> RegressionBranch:
    """(..., C) -> (..., outputs)."""
    hidden = [module for _ in range(layers - 1) for module in (nn.Linear(channels, channels), nn.ReLU())]
    return RegressionBranch(*hidden, nn.Linear(channels, outputs))


class BestBoxes(NamedTuple):
    """The K boxes of each batch element with the best scores, by falling score."""

    query: Tensor  # (B, K), index of the object query
    label: Tensor  # (B, K), index of the class
    scores: Tensor  # (B, K)
    codes: Tensor  # (B, K, 10)

    def decoded(self, classes: Sequence[str]) -> Boxes3D:
        """The boxes of a batch of one, bev frame. classes: of the class logits."""
        codes, scores = (column[0].double().cpu().numpy() for column in (self.codes, self.scores))
        return boxes_of_codes(codes, np.asarray(classes)[self.label[0].cpu().numpy()], scores)

    def with_scores(self, scores: Tensor) -> "BestBoxes":
        """The same boxes with other scores (B, K), by falling score."""
        scores, order = scores.topk(scores.shape[1])
        codes = self.codes.gather(1, order[..., None].expand_as(self.codes))
        return BestBoxes(self.query.gather(1, order), self.label.gather(1, order), scores, codes)

    def of_same_class(self) -> Tensor:
        """(B, K, K) float32, 1 where two boxes have the same class, else 0."""
        label = self.label.float()  # a CPU compares these three times as fast
        return (label[:, :, None] == label[:, None]).float()

    def squared_distances(self) -> Tensor:
        """(B, K, K) float32, m², between the boxes on the ground."""
        # A sum over a last axis of two takes several times as long.
        x, y = self.codes[..., :2].float().unbind(-1)
        x, y = x.contiguous(), y.contiguous()
        return (x[:, :, None] - x[:, None]).square() + (y[:, :, None] - y[:, None]).square()


def best_boxes(class_logits: Tensor, box_codes: Tensor, config: DecoderConfig) -> BestBoxes:
    """The config.max_boxes best boxes, with duplicates merged and faded as the configuration says.

    class_logits: (B, Q, classes). box_codes: (B, Q, 10).
    """
    scores, query, label = best_classes(class_logits.float(), config.max_boxes)
    codes = box_codes.gather(1, query[..., None].expand(-1, -1, box_codes.shape[-1]))
    boxes = BestBoxes(query, label, scores, codes)
    if config.merge_duplicates:
        boxes = merged(boxes, config.merge_duplicates)
    if config.fade_duplicates:
        boxes = faded(boxes, config.fade_duplicates)
    return boxes


def merged(boxes: BestBoxes, reach: float) -> BestBoxes:
    """Each box at the mean place of the boxes of its class around it, which also raise its score.

    Several queries that find the same object err differently, so that their mean is nearer to it (weighted boxes
    fusion, Solovyev et al. 2019, does so with boxes in images). A box at a distance of d counts by its score times
    exp(-(d / (reach · size))²), where the size is the root of width times length. If those of the others add up to n, a
    score s becomes 1 - (1 - s)^(1 + SUPPORT · n).
    """
    size = boxes.codes[..., 2:4].float().mean(-1, keepdim=True).exp()  # of the logarithms of width and length
    weights = boxes.scores.clamp(min=1e-6)[:, None]
    near = (boxes.squared_distances() / -(reach * size).square()).clamp(min=LEAST_EXPONENT).exp()
    counts = near * boxes.of_same_class() * weights  # (B, K, K)
    total = counts.sum(-1)
    places = counts @ boxes.codes[..., :2].float() / total[..., None]
    moved = boxes._replace(codes=torch.cat([places.to(boxes.codes.dtype), boxes.codes[..., 2:]], dim=-1))
    return moved.with_scores(1 - (1 - boxes.scores) ** (1 + SUPPORT * (total - weights[:, 0])))


def faded(boxes: BestBoxes, share: float) -> BestBoxes:
    """Boxes near a better box of their class with lower scores, as by soft non-maximum suppression.

    At a distance of d widths of the better box, a score is multiplied by 1 - share · exp(-d / FADING_WIDTHS); of
    several better boxes, the one counts that lowers it most.
    """
    distances = boxes.squared_distances().sqrt()  # (B, better, worse)
    widths = boxes.codes[..., 2].float().exp()[:, :, None]
    lost = share * (distances / (-FADING_WIDTHS * widths)).clamp(min=LEAST_EXPONENT).exp()
    rank = torch.arange(boxes.scores.shape[1], device=lost.device)
    worse = rank[:, None] < rank  # `triu` takes as long as all the rest
    return boxes.with_scores(boxes.scores * (1 - boxes.of_same_class() * worse * lost).amin(1))


def encode(boxes: Boxes3D) -> Array:
    """Boxes in the bev frame -> codes (N, 10), the targets of training; unknown velocities are NaN."""
    length, width, height = boxes.sizes_lwh.T
    angle = -boxes.yaws - np.pi / 2
    x, y, z = boxes.centers.T
    columns = [x, y, np.log(width), np.log(length), z, np.log(height), np.sin(angle), np.cos(angle)]
    return np.concatenate([np.stack(columns, axis=-1), boxes.velocities], axis=-1)


def boxes_of_codes(code: Array, classes: np.ndarray, scores: Array) -> Boxes3D:
    """The inverse of `encode`, for codes (N, 10) with the classes (N,) and scores (N,) of their boxes."""
    angle = np.arctan2(code[:, 6], code[:, 7])
    return Boxes3D(
        centers=code[:, [0, 1, 4]],
        sizes_lwh=np.exp(code[:, [3, 2, 5]]),
        yaws=wrap_angle(-angle - np.pi / 2),
        velocities=code[:, 8:],
        classes=classes,
        scores=scores,
    )
