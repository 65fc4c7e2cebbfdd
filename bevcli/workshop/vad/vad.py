"""VAD (Jiang et al. 2023): BEVFormer's BEV map and objects, lines of the map, futures of objects, a planned path."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Self

import numpy as np
import torch
import torch.nn.functional as F
from msgspec import Meta
from torch import Tensor, nn

from bevcli.errors import ConfigError
from bevcli.frame import BevMap, FrameResult
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.model.bevformer import BEVFormer
from bevcli.model.config import ModelConfig
from bevcli.model.decoder import (
    ConstantSelfAttention,
    DecoderConfig,
    DecoderLayer,
    ObjectQueries,
    best_boxes,
    best_classes,
    branch,
    class_branch,
    inverse_sigmoid,
)
from bevcli.model.encoder import FeedForward
from bevcli.model.network import STAGES
from bevcli.model.step import ModelOutputs
from bevcli.model.temporal_model import OfficialNames, Renames
from bevcli.model.upload import without_autocast
from bevcli.parsing.documents import Count, Positive, ShareBelowOne
from bevcli.workshop.formats.map_lines import MapLines
from bevcli.workshop.vad.plan import Plan


@dataclass(frozen=True)
class LineDecoderConfig:
    """The map decoder."""

    classes: tuple[str, ...] = ("divider", "ped_crossing", "boundary")  # of the lines, in the order of the class logits
    lines: Count = 100  # number of line queries
    line_points: Annotated[int, Meta(ge=2)] = 20  # number of points of a line
    layers: Count = 3  # number of decoder layers
    attention_heads: Count = 8  # heads of self-attention and of cross-attention
    points: Count = 4  # sampling points of a head of the cross-attention to the BEV map
    feed_forward_width: Count = 512  # channels between the two linear layers of the feed-forward network
    dropout: ShareBelowOne = 0.1  # probability
    max_lines: Count = 50  # number of lines that are decoded, those with the best scores

    def __post_init__(self) -> None:
        if not self.classes:
            raise ValueError("expected at least one class")

    def transformer(self) -> DecoderConfig:
        """The settings of the layers, which are those of the object decoder."""
        return DecoderConfig.of_head(self, self.layers, queries=self.lines * self.line_points)


@dataclass(frozen=True)
class LineOutputs:
    """The N lines of P points of all L layers."""

    class_logits: Tensor  # (L, B, N, classes)
    points: Tensor  # (L, B, N, P, 2) x and y, 0 to 1 over the range of the BEV grid
    features: Tensor  # (B, N, P, C) of the points, after the last layer


class LineDecoder(nn.Module):
    """Queries of points that attend to each other, of all lines, and to the BEV map."""

    def __init__(self, config: LineDecoderConfig, channels: int, grid: BevGrid) -> None:
        super().__init__()
        self.shape = (config.lines, config.line_points)
        # The first half of the channels is the position of a query, the second half its content.
        self.line_embedding = nn.Parameter(torch.randn(config.lines, 2 * channels))
        self.point_embedding = nn.Parameter(torch.randn(config.line_points, 2 * channels))
        self.reference_points = nn.Linear(channels, 2)
        transformer, bev_shape = config.transformer(), (grid.rows, grid.columns)
        self.layers = nn.ModuleList(DecoderLayer(transformer, channels, bev_shape) for _ in range(config.layers))
        self.class_branches = nn.ModuleList(class_branch(channels, len(config.classes)) for _ in range(config.layers))
        self.point_branches = nn.ModuleList(branch(channels, 3, 2) for _ in range(config.layers))
        nn.init.xavier_uniform_(self.reference_points.weight)
        nn.init.zeros_(self.reference_points.bias)

    def forward(self, bev: Tensor) -> LineOutputs:
        """The lines in a BEV map (B, Y·X, C)."""
        queries = self.queries(len(bev))
        query, points = queries.content, queries.reference_points
        class_logits, all_points = [], []
        for layer, classes, moves in zip(self.layers, self.class_branches, self.point_branches, strict=True):
            query = layer(query, queries.position, points, bev)
            refined = (moves(query) + inverse_sigmoid(points)).sigmoid()
            class_logits.append(classes(query.unflatten(1, self.shape).mean(2)))
            all_points.append(refined.unflatten(1, self.shape))
            points = refined.detach()
        return LineOutputs(torch.stack(class_logits), torch.stack(all_points), query.unflatten(1, self.shape))

    def queries(self, batch: int) -> ObjectQueries:
        """The learned queries (B, N · P, …), the points of a line one after another; reference points are x and y."""
        embedding = (self.line_embedding[:, None] + self.point_embedding).flatten(0, 1)
        position, content = embedding.expand(batch, -1, -1).chunk(2, dim=-1)
        return ObjectQueries(position, content, self.reference_points(position).sigmoid())


class LineEncoder(nn.Module):
    """One vector a line, from the features of its points (VectorNet, Gao et al. 2020)."""

    def __init__(self, channels: int, layers: int = 3) -> None:
        super().__init__()
        half = channels // 2
        self.layers = nn.ModuleList(
            nn.Sequential(nn.Linear(channels, half), nn.LayerNorm(half), nn.ReLU()) for _ in range(layers)
        )

    def forward(self, features: Tensor) -> Tensor:
        """features: (B, N, P, C) -> (B, N, C)."""
        for layer in self.layers:
            hidden = layer(features)
            features = torch.cat([hidden, hidden.amax(2, keepdim=True).expand_as(hidden)], dim=-1)
        return features.amax(2)


@dataclass(frozen=True)
class MotionConfig:
    """The motion head and the planner."""

    modes: Count = 6  # M, number of futures of an object
    steps: Count = 6  # T, number of steps of a future and of a planned path
    step_s: Positive = 0.5  # seconds of a step
    attention_heads: Count = 8  # heads of the four attentions
    feed_forward_width: Count = 512  # channels between the two linear layers of the feed-forward networks
    dropout: ShareBelowOne = 0.1  # probability
    min_line_score: float = 0.5  # objects attend to lines with a higher score
    max_line_distance: float = 0.2  # objects attend to lines up to it, in shares of the range of the BEV grid

    def attention(self, channels: int) -> "AttentionLayer":
        """An attention layer with these settings."""
        return AttentionLayer(channels, self.attention_heads, self.feed_forward_width, self.dropout)


@dataclass(frozen=True)
class MapTokens:
    """The N lines as motion head and planner see them."""

    features: Tensor  # (B, N, C), one vector a line
    positions: Tensor  # (B, N, 2), one point of each line, 0 to 1 over the range: see `line_positions`
    scores: Tensor  # (B, N), of the best class, 0 to 1


@dataclass(frozen=True)
class MotionOutputs:
    """The futures of Q objects."""

    offsets: Tensor  # (B, Q, M, T, 2) movement in each step along x and y of the bev frame, metres
    mode_logits: Tensor  # (B, Q, M)
    features: Tensor  # (B, Q, C), one vector an object, for the planner


class MotionHead(nn.Module):
    """M futures of each object. Modes of all objects attend to each other, then to the lines near their object."""

    def __init__(self, config: MotionConfig, channels: int) -> None:
        super().__init__()
        self.config = config
        self.mode_queries = nn.Parameter(torch.randn(config.modes, channels))
        self.agent_attention = config.attention(channels)
        self.agent_position = nn.Linear(2, channels)
        self.line_attention = config.attention(channels)
        self.line_position = nn.Linear(2, channels)
        self.trajectory_branch = branch(2 * channels, 3, 2 * config.steps)
        self.mode_branch = class_branch(2 * channels, 1)
        self.agent_fusion = nn.Sequential(
            nn.Linear(2 * config.modes * channels, channels),
            nn.LayerNorm(channels),
            nn.ReLU(),
            nn.Linear(channels, channels),
        )

    def forward(self, features: Tensor, positions: Tensor, lines: MapTokens) -> MotionOutputs:
        """features: (B, Q, C) of the objects. positions: (B, Q, 2) their centres, 0 to 1 over the range."""
        modes = (features[:, :, None] + self.mode_queries).flatten(1, 2)  # (B, Q·M, C)
        position = self.agent_position(positions).repeat_interleave(self.config.modes, dim=1)
        modes = self.agent_attention(modes, position, modes, position)
        modes = modes.unflatten(1, (-1, self.config.modes))  # (B, Q, M, C)
        attended = torch.cat([modes, self._attend_to_lines(modes, positions, lines)], dim=-1)  # (B, Q, M, 2 C)
        offsets = self.trajectory_branch(attended).unflatten(-1, (self.config.steps, 2))
        return MotionOutputs(offsets, self.mode_branch(attended)[..., 0], self.agent_fusion(attended.flatten(2)))

    def _attend_to_lines(self, modes: Tensor, positions: Tensor, lines: MapTokens) -> Tensor:
        """(B, Q, M, C): each object attends to its own lines, at their positions relative to it."""
        relative, masked = self.lines_in_reach(positions, lines)
        features = F.pad(lines.features, (0, 0, 0, 1))  # the entry without a line has no features
        values = features[:, None].expand(-1, positions.shape[1], -1, -1)
        # As in the released code, the object itself is at the origin.
        origin = self.line_position(positions.new_zeros(1, 1, 2))
        attended = self.line_attention(
            modes.flatten(0, 1),
            origin,
            values.flatten(0, 1),
            self.line_position(relative).flatten(0, 1),
            masked.flatten(0, 1),
        )
        return attended.unflatten(0, modes.shape[:2])

    def lines_in_reach(self, positions: Tensor, lines: MapTokens) -> tuple[Tensor, Tensor]:
        """Relative positions (B, Q, N + 1, 2) of the lines, and masks (B, Q, N + 1) of those not attended to.

        The last entry is no line: an object without lines in reach attends to it alone. It is at (1, 1), as in the
        released code.
        """
        relative = lines.positions[:, None] - positions[:, :, None]  # (B, Q, N, 2)
        is_far = relative.norm(dim=-1) > self.config.max_line_distance
        masked = is_far | (lines.scores <= self.config.min_line_score)[:, None]
        return F.pad(relative, (0, 0, 0, 1), value=1.0), F.pad(masked, (0, 1), value=False)


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


def line_positions(points: Tensor) -> Tensor:
    """The position (B, N, 2) of lines with points (B, N, P, 2), 0 to 1 over the range.

    As in the released code it is the point nearest to the corner of the range, (0, 0), not to the vehicle.
    """
    nearest = points.norm(dim=-1).argmin(-1)  # (B, N)
    return points.gather(2, nearest[..., None, None].expand(-1, -1, 1, 2))[:, :, 0]


class Planner(nn.Module):
    """One path for each command. Nothing else of the vehicle enters: its speed is in the BEV map only."""

    def __init__(self, config: MotionConfig, commands: int, channels: int) -> None:
        super().__init__()
        self.shape = (commands, config.steps, 2)
        self.ego_query = nn.Parameter(torch.randn(1, channels))
        self.agent_attention = config.attention(channels)
        self.agent_position = nn.Linear(2, channels)
        self.line_attention = config.attention(channels)
        self.line_position = nn.Linear(2, channels)
        self.path_branch = branch(2 * channels, 3, commands * config.steps * 2)

    def forward(self, features: Tensor, positions: Tensor, lines: MapTokens) -> Tensor:
        """Movement (B, commands, T, 2) in each step along x and y of the bev frame, metres.

        Args:
            features: (B, Q, C) of the objects, `MotionOutputs.features`.
            positions: (B, Q, 2) their centres, 0 to 1 over the range.
            lines: all are attended to, whatever their scores.
        """
        corner = positions.new_zeros(1, 1, 2)  # the released code places the vehicle there, not in the middle
        ego = self.ego_query.expand(len(features), -1, -1)  # (B, 1, C)
        with_agents = self.agent_attention(ego, self.agent_position(corner), features, self.agent_position(positions))
        with_lines = self.line_attention(
            with_agents, self.line_position(corner), lines.features, self.line_position(lines.positions)
        )
        return self.path_branch(torch.cat([with_agents, with_lines], dim=-1)[:, 0]).unflatten(-1, self.shape)


@dataclass(frozen=True, kw_only=True)
class VADConfig(ModelConfig):
    """A whole VAD."""

    architecture: ClassVar[str] = "VAD"

    commands: tuple[str, ...] = ("right", "left", "straight")  # of the driver, in the order of the planned paths
    line_decoder: LineDecoderConfig = field(default_factory=LineDecoderConfig)  # the map decoder
    motion: MotionConfig = field(default_factory=MotionConfig)  # the motion head and the planner

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.heads != ("detection",) or self.decoder.training_groups != 1:
            raise ValueError('heads must be ["detection"] and decoder.training_groups 1: VAD has heads of its own')
        if self.channels % self.line_decoder.attention_heads or self.channels % self.motion.attention_heads:
            raise ValueError(f"channels is {self.channels}; it must be a multiple of the attention_heads")
        if not self.commands or len(set(self.commands)) < len(self.commands):
            raise ValueError("commands must name at least one command, and none twice")

    @property
    def results(self) -> Mapping[type[FrameResult], tuple[str, ...]]:
        return {MapLines: self.line_decoder.classes, Plan: self.commands}

    @property
    def future_times_s(self) -> tuple[float, ...]:
        return tuple(self.motion.step_s * step for step in range(1, self.motion.steps + 1))

    def check_training(self, clip_frames: int) -> None:
        raise ConfigError(f"{self.name}: a VAD cannot be trained; expected a BEVFormer, such as tiny, small or base")


_RENAMES: Renames = (
    (r"^pts_bbox_head\.map_instance_embedding\.weight$", "line_decoder.line_embedding"),
    (r"^pts_bbox_head\.map_pts_embedding\.weight$", "line_decoder.point_embedding"),
    (r"^pts_bbox_head\.transformer\.map_reference_points\.", "line_decoder.reference_points."),
    (r"^pts_bbox_head\.transformer\.map_decoder\.", "line_decoder."),
    (r"^pts_bbox_head\.map_cls_branches\.", "line_decoder.class_branches."),
    (r"^pts_bbox_head\.map_reg_branches\.", "line_decoder.point_branches."),
    (r"^pts_bbox_head\.lane_encoder\.layer_seq\.lmlp_(\d)\.mlp\.", r"line_encoder.layers.\1."),
    (r"^pts_bbox_head\.motion_mode_query\.weight$", "motion_head.mode_queries"),
    (r"^pts_bbox_head\.motion_decoder\.layers\.0\.", "motion_head.agent_attention."),
    (r"^pts_bbox_head\.pos_mlp_sa\.", "motion_head.agent_position."),
    (r"^pts_bbox_head\.motion_map_decoder\.layers\.0\.", "motion_head.line_attention."),
    (r"^pts_bbox_head\.pos_mlp\.", "motion_head.line_position."),
    (r"^pts_bbox_head\.traj_branches\.0\.", "motion_head.trajectory_branch."),
    (r"^pts_bbox_head\.traj_cls_branches\.0\.", "motion_head.mode_branch."),
    (r"^pts_bbox_head\.agent_fus_mlp\.", "motion_head.agent_fusion."),
    (r"^pts_bbox_head\.ego_query\.weight$", "planner.ego_query"),
    (r"^pts_bbox_head\.ego_agent_decoder\.layers\.0\.", "planner.agent_attention."),
    (r"^pts_bbox_head\.ego_agent_pos_mlp\.", "planner.agent_position."),
    (r"^pts_bbox_head\.ego_map_decoder\.layers\.0\.", "planner.line_attention."),
    (r"^pts_bbox_head\.ego_map_pos_mlp\.", "planner.line_position."),
    (r"^pts_bbox_head\.ego_fut_decoder\.", "planner.path_branch."),
    (r"^((motion_head|planner)\..*)\.attentions\.0\.attn\.", r"\1.attention."),
)

# The weights of the loss are used in training only.
OFFICIAL_NAMES = OfficialNames(
    r"^pts_bbox_head\.map_", _RENAMES, unused=r"^pts_bbox_head\.map_code_weights$", unused_text="{first}"
)

PART_NAMES = (
    ("map decoder", "line_decoder"),
    ("line encoder", "line_encoder"),
    ("motion head: objects to objects", "motion_head.agent_attention", "motion_head.agent_position"),
    ("motion head: objects to lines", "motion_head.line_attention", "motion_head.line_position"),
    ("motion head: futures", "motion_head"),
    ("planner: vehicle to objects", "planner.agent_attention", "planner.agent_position"),
    ("planner: vehicle to lines", "planner.line_attention", "planner.line_position"),
    ("planner: paths", "planner"),
)


@dataclass(frozen=True, kw_only=True)
class VADOutputs(ModelOutputs):
    """The outputs of one step."""

    lines: LineOutputs  # of the map
    motion: MotionOutputs  # the futures of the object queries
    plan: Tensor  # (B, commands, T, 2) movement of the vehicle in each step along x and y of the bev frame, metres

    @property
    def by_name(self) -> dict[str, Tensor]:
        """See `ModelOutputs`."""
        return {
            **super().by_name,
            "line_class_logits": self.lines.class_logits[-1],
            "line_points": self.lines.points[-1],
            "future_offsets": self.motion.offsets,
            "mode_logits": self.motion.mode_logits,
            "plan_offsets": self.plan,
        }

    @classmethod
    def of_names(cls, tensors: Mapping[str, Tensor]) -> Self:
        """See `ModelOutputs`. Features between the heads are not in the file."""
        base, none = ModelOutputs.of_names(tensors), torch.zeros(0)
        return cls(
            base.bev,
            base.class_logits,
            base.box_codes,
            lines=LineOutputs(tensors["line_class_logits"][None], tensors["line_points"][None], none),
            motion=MotionOutputs(tensors["future_offsets"], tensors["mode_logits"], none),
            plan=tensors["plan_offsets"],
        )

    @classmethod
    def ports(cls, config: ModelConfig) -> Iterator[tuple[str, tuple[int, ...], str]]:
        """See `ModelOutputs`."""
        assert isinstance(config, VADConfig)
        yield from super().ports(config)
        lines, motion, queries = config.line_decoder, config.motion, config.decoder.queries
        commands = config.commands
        yield (
            "line_class_logits",
            (1, lines.lines, len(lines.classes)),
            f"(1, N, classes): of lines of the map: {', '.join(lines.classes)}.",
        )
        yield (
            "line_points",
            (1, lines.lines, lines.line_points, 2),
            "(1, N, P, 2): points of the lines, x and y, 0 to 1 over x_range_m and y_range_m.",
        )
        yield (
            "future_offsets",
            (1, queries, motion.modes, motion.steps, 2),
            f"(1, Q, M, T, 2): movement of each object in each step of {motion.step_s:g} s, x and y in metres, bev "
            "frame. Sums over the steps, added to the centre, are places.",
        )
        yield "mode_logits", (1, queries, motion.modes), "(1, Q, M): of the futures."
        yield (
            "plan_offsets",
            (1, len(commands), motion.steps, 2),
            f"(1, commands, T, 2): movement of the vehicle in each step, for the commands {', '.join(commands)}.",
        )

    def last_layers(self) -> Self:
        """See `ModelOutputs`. Features, which only the network uses, are left out."""
        lines, none = self.lines, self.plan[:0]
        last = LineOutputs(lines.class_logits[-1:], lines.points[-1:], none)
        return replace(super().last_layers(), lines=last, motion=replace(self.motion, features=none))


class VAD(BEVFormer):
    """The whole model: a recurrence, in which the BEV map of a frame is the history of the next."""

    config: VADConfig
    config_class = VADConfig
    stages: Mapping[str, str] = STAGES | {"line_decoder": "map_decoder", "motion_head": "motion", "planner": "planner"}
    outputs_type = VADOutputs
    official_names = OFFICIAL_NAMES

    def __init__(self, config: VADConfig) -> None:
        super().__init__(config)
        self.line_decoder = LineDecoder(config.line_decoder, config.channels, config.bev_grid)
        self.line_encoder = LineEncoder(config.channels)
        self.motion_head = MotionHead(config.motion, config.channels)
        self.planner = Planner(config.motion, len(config.commands), config.channels)

    def fix_constant_parts(self) -> None:
        """The queries of objects and of lines attend to each other before they see the frame: computed once."""
        super().fix_constant_parts()
        first = self.line_decoder.layers[0]
        first.self_attention = ConstantSelfAttention(first, self.line_decoder.queries(batch=1))

    def part_names(self) -> Iterator[tuple[str, ...]]:
        """See `TemporalModel`."""
        yield from super().part_names()
        yield from PART_NAMES

    def detect(self, bev: Tensor) -> VADOutputs:
        """The outputs for a BEV map (B, Y·X, C)."""
        with without_autocast(bev.device):
            class_logits, box_codes, features = self.decoder(bev.float(), self.detection_head)
            lines, motion, plan = self.further(bev.float(), box_codes[-1], features)
        return VADOutputs(bev, class_logits, box_codes, lines=lines, motion=motion, plan=plan)

    def further(self, bev: Tensor, box_codes: Tensor, features: Tensor) -> tuple[LineOutputs, MotionOutputs, Tensor]:
        """Lines, futures and plan for a BEV map, and box codes (B, Q, 10) and features (B, Q, C) of objects."""
        lines = self.line_decoder(bev)
        tokens, positions = self.map_tokens(lines), self.positions(box_codes)
        motion = self.motion_head(features, positions, tokens)
        return lines, motion, self.planner(motion.features, positions, tokens)

    def map_tokens(self, lines: LineOutputs) -> MapTokens:
        scores = lines.class_logits[-1].sigmoid().amax(-1)
        return MapTokens(self.line_encoder(lines.features), line_positions(lines.points[-1]), scores)

    def positions(self, box_codes: Tensor) -> Tensor:
        """x and y (B, Q, 2), 0 to 1 over the range, of box codes (B, Q, 10)."""
        head = self.detection_head
        return (box_codes[..., :2] - head.range_start[:2]) / head.range_extent[:2]

    def decode(self, outputs: ModelOutputs) -> Iterator[Boxes3D | BevMap | FrameResult]:
        assert isinstance(outputs, VADOutputs)
        config = self.config
        yield decode_futures(outputs, config)
        yield decode_lines(outputs, config)
        yield Plan(config.commands, _array(outputs.plan[0]).cumsum(1), np.array(config.future_times_s))


def decode_futures(outputs: VADOutputs, config: VADConfig) -> Boxes3D:
    """The boxes of `ModelOutputs.boxes`, with futures: the places of each object's centre in each mode."""
    best = best_boxes(outputs.class_logits[-1], outputs.box_codes[-1], config.decoder)
    boxes, queries = best.decoded(config.classes), best.query[0]
    offsets = _array(outputs.motion.offsets[0, queries])  # (K, M, T, 2)
    places = boxes.centers[:, None, None, :2] + offsets.cumsum(2)
    seconds = np.broadcast_to(np.array(config.future_times_s)[:, None], (*places.shape[:3], 1))
    scores = _array(outputs.motion.mode_logits[0, queries].sigmoid())
    return replace(boxes, futures=np.concatenate([seconds, places], axis=-1), future_scores=scores)


def decode_lines(outputs: VADOutputs, config: VADConfig) -> MapLines:
    """The line_decoder.max_lines lines with the best scores, by falling score, bev frame; see `best_classes`."""
    decoder = config.line_decoder
    scores, queries, labels = (column[0] for column in best_classes(outputs.lines.class_logits[-1], decoder.max_lines))
    (x0, x1), (y0, y1) = config.bev_grid.x_range_m, config.bev_grid.y_range_m
    points = _array(outputs.lines.points[-1, 0, queries]) * (x1 - x0, y1 - y0) + (x0, y0)  # (K, P, 2)
    return MapLines(tuple(points), np.asarray(decoder.classes)[labels.cpu().numpy()], _array(scores))


def _array(values: Tensor) -> Array:
    return np.asarray(values.double().cpu())
