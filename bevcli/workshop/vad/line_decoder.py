"""The map decoder of VAD: queries of points, grouped into lines, attend to the BEV map and move to the map's lines."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.decoder import DecoderConfig, DecoderLayer, ObjectQueries, branch, class_branch, inverse_sigmoid


@dataclass(frozen=True)
class LineDecoderConfig:
    """The map decoder.

    Attributes:
        classes: of the lines, in the order of the class logits.
        lines: number of line queries.
        line_points: number of points of a line.
        layers: number of decoder layers.
        attention_heads: heads of self-attention and of cross-attention.
        points: sampling points of a head of the cross-attention to the BEV map.
        feed_forward_width: channels between the two linear layers of the feed-forward network.
        dropout: probability, 0 to below 1.
        max_lines: number of lines that are decoded, those with the best scores.
    """

    classes: tuple[str, ...] = ("divider", "ped_crossing", "boundary")
    lines: int = 100
    line_points: int = 20
    layers: int = 3
    attention_heads: int = 8
    points: int = 4
    feed_forward_width: int = 512
    dropout: float = 0.1
    max_lines: int = 50

    def __post_init__(self) -> None:
        if not self.classes or min(self.lines, self.max_lines) < 1 or self.line_points < 2:
            raise ValueError("expected at least one class, one line and two line_points")
        self.transformer()  # checks the other numbers

    def transformer(self) -> DecoderConfig:
        """The settings of the layers, which are those of the object decoder."""
        return DecoderConfig.of_head(self, self.layers, queries=self.lines * self.line_points)


@dataclass(frozen=True)
class LineOutputs:
    """The N lines of P points of all L layers.

    Attributes:
        class_logits: (L, B, N, classes).
        points: (L, B, N, P, 2) x and y, 0 to 1 over the range of the BEV grid.
        features: (B, N, P, C) of the points, after the last layer.
    """

    class_logits: Tensor
    points: Tensor
    features: Tensor


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
