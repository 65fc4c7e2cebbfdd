"""The loss of the map's lines: each is matched to a true one in that order of points that fits best (MapTR)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from shapely import LineString, box, get_coordinates, get_parts, line_interpolate_point, line_merge
from torch import Tensor

from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.transforms import Array
from bevcli.workshop.training.detection_loss import focal_cost, focal_loss, hungarian_matching
from bevcli.workshop.vad.config import LossWeights
from bevcli.workshop.vad.line_decoder import LineDecoderConfig, LineOutputs
from bevcli.workshop.vad.map_lines import MapLines

CLOSED_M = 0.01  # a line whose ends are so near to each other is closed
SHORTEST_M = 0.5  # shorter rests of lines that the range cuts are left out


@dataclass(frozen=True)
class LineTargets:
    """The G true lines of a frame.

    Attributes:
        labels: (G,) int64.
        orders: (G, R, P, 2) points in all orders that describe the same line, 0 to 1 over the range. There are
            R = 2 (P - 1): a closed line starts at any point in both directions; those of an open one repeat.
    """

    labels: Tensor
    orders: Tensor


def line_targets(lines: MapLines, config: LineDecoderConfig, grid: BevGrid, device: torch.device) -> LineTargets:
    """Targets from the parts of the true lines (bev frame) inside the range that have one of the classes."""
    (x0, x1), (y0, y1) = grid.x_range_m, grid.y_range_m
    labels: list[int] = []
    orders: list[Array] = []
    for name, points in zip(lines.classes, lines.points, strict=True):
        for part in _inside(points, grid) if name in config.classes else ():
            labels.append(config.classes.index(name))
            orders.append(_orders((_resampled(part, config.line_points) - (x0, y0)) / (x1 - x0, y1 - y0)))
    shape = (-1, 2 * (config.line_points - 1), config.line_points, 2)
    of_lines = torch.tensor(np.array(orders), dtype=torch.float32, device=device).reshape(shape)
    return LineTargets(torch.tensor(labels, dtype=torch.int64, device=device), of_lines)


def _inside(points: Array, grid: BevGrid) -> Iterator[LineString]:
    (x0, x1), (y0, y1) = grid.x_range_m, grid.y_range_m
    for part in get_parts(line_merge(LineString(points[:, :2]).intersection(box(x0, y0, x1, y1)))):
        if part.length >= SHORTEST_M:
            yield part


def _resampled(part: LineString, count: int) -> Array:
    """(count, 2) points, equally spaced along the line; the ends of a closed line are equal."""
    points: Array = get_coordinates(line_interpolate_point(part, np.linspace(0, 1, count), normalized=True))
    if np.linalg.norm(points[0] - points[-1]) < CLOSED_M:
        points[-1] = points[0]
    return points


def _orders(points: Array) -> Array:
    """(R, P, 2) of (P, 2): see `LineTargets`."""
    starts = len(points) - 1
    if (points[0] != points[-1]).any():
        return np.concatenate([np.stack([points, points[::-1]])] * starts)
    ring = points[:-1]
    turned = np.stack([np.roll(ring, -start, axis=0) for start in range(starts)])
    forward = np.concatenate([turned, turned[:, :1]], axis=1)
    return np.concatenate([forward, forward[:, ::-1]])


def line_losses(
    outputs: LineOutputs, targets: Sequence[LineTargets], weights: LossWeights, extent_m: Tensor
) -> dict[str, Tensor]:
    """The weighted scalar losses of all decoder layers, divided by the number of matched lines of the batch.

    targets: B. extent_m: (2,) of the range in x and y.
    """
    layers = zip(outputs.class_logits, outputs.points, strict=True)
    totals = torch.stack([_layer_loss(*layer, targets, weights, extent_m) for layer in layers]).sum(0)
    return dict(zip(("line classes", "line points", "line directions"), totals, strict=True))


def _layer_loss(
    logits: Tensor, points: Tensor, targets: Sequence[LineTargets], weights: LossWeights, extent_m: Tensor
) -> Tensor:
    """(3,) losses of one decoder layer. logits: (B, N, classes). points: (B, N, P, 2)."""
    class_targets, found, true = torch.zeros_like(logits), [], []
    for element, truth in enumerate(targets):
        costs, best = matching_costs(logits[element], points[element], truth, weights)
        queries, lines = hungarian_matching(costs)
        class_targets[element, queries, truth.labels[lines]] = 1
        found.append(points[element, queries])
        true.append(truth.orders[lines, best[queries, lines]])
    at, wanted = torch.cat(found), torch.cat(true)  # (K, P, 2)
    classes = weights.line_class * focal_loss(logits, class_targets).sum()
    distances = weights.line_points * F.l1_loss(at, wanted, reduction="sum")
    segments, true_segments = (each.diff(dim=1) * extent_m for each in (at, wanted))
    turned = weights.line_direction * (1 - F.cosine_similarity(segments, true_segments, dim=-1)).sum()
    return torch.stack([classes, distances, turned]) / max(len(at), 1)


@torch.no_grad()
def matching_costs(logits: Tensor, points: Tensor, truth: LineTargets, weights: LossWeights) -> tuple[Tensor, Tensor]:
    """(N, G) focal cost plus L1 distance in the best order of points, and (N, G) the index of that order.

    Args:
        logits: (N, classes).
        points: (N, P, 2), 0 to 1 over the range.
        truth: G lines.
    """
    orders = truth.orders.flatten(2)  # (G, R, 2 P)
    distances = torch.cdist(points.flatten(1), orders.flatten(0, 1), p=1).unflatten(1, orders.shape[:2])  # (N, G, R)
    nearest, best = distances.min(-1)
    return weights.line_class * focal_cost(logits)[:, truth.labels] + weights.line_points * nearest, best
