"""The heads of VAD: the map decoder finds lines; objects and the own vehicle attend to each other and to the lines.

The futures of the objects and the planned paths come of that attention.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.decoder import DecoderConfig, DecoderLayer, ObjectQueries, branch, class_branch, inverse_sigmoid
from bevcli.model.encoder import FeedForward


@dataclass(frozen=True)
class LineDecoderConfig:
    """The map decoder."""

    classes: tuple[str, ...] = ("divider", "ped_crossing", "boundary")  # of the lines, in the order of the class logits
    lines: int = 100  # number of line queries
    line_points: int = 20  # number of points of a line
    layers: int = 3  # number of decoder layers
    attention_heads: int = 8  # heads of self-attention and of cross-attention
    points: int = 4  # sampling points of a head of the cross-attention to the BEV map
    feed_forward_width: int = 512  # channels between the two linear layers of the feed-forward network
    dropout: float = 0.1  # probability, 0 to below 1
    max_lines: int = 50  # number of lines that are decoded, those with the best scores

    def __post_init__(self) -> None:
        if not self.classes or min(self.lines, self.max_lines) < 1 or self.line_points < 2:
            raise ValueError("expected at least one class, one line and two line_points")
        self.transformer()  # checks the other numbers

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

    modes: int = 6  # M, number of futures of an object
    steps: int = 6  # T, number of steps of a future and of a planned path
    step_s: float = 0.5  # seconds of a step
    attention_heads: int = 8  # heads of the four attentions
    feed_forward_width: int = 512  # channels between the two linear layers of the feed-forward networks
    dropout: float = 0.1  # probability, 0 to below 1
    min_line_score: float = 0.5  # objects attend to lines with a higher score
    # objects attend to lines up to this distance, in shares of the range of the BEV grid
    max_line_distance: float = 0.2

    def __post_init__(self) -> None:
        counts = (self.modes, self.steps, self.attention_heads, self.feed_forward_width)
        if min(counts) < 1 or self.step_s <= 0 or not 0 <= self.dropout < 1:
            raise ValueError("modes, steps, step_s, heads and width must be positive, dropout from 0 to below 1")

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
