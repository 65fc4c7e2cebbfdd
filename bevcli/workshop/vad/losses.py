"""The training of VAD's own heads: the ground truth of a frame beyond boxes, and the losses (VAD, section 3.4).

Each predicted line is matched to a true one in that order of points that fits best (MapTR). The constraints know the
scene from the model's own lines and futures, which they do not change.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from shapely import LineString, box, get_coordinates, get_parts, line_interpolate_point, line_merge
from torch import Tensor

from bevcli.errors import InputError
from bevcli.frame import Drive, Frame, result_of
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.sequences.files.boxes_file import FrameBoxes
from bevcli.workshop.formats.map_lines import BOUNDARY, DIVIDER, TRUE_LINES, MapLines
from bevcli.workshop.training.losses import focal_cost, focal_loss, hungarian_matching
from bevcli.workshop.training.targets import OwnHeads, boxes_inside
from bevcli.workshop.vad.driving_scores import LATE_S, FramesByTime, followed, with_true_futures
from bevcli.workshop.vad.heads import LineDecoderConfig, LineOutputs, MotionOutputs
from bevcli.workshop.vad.vad import LossWeights, VADConfig, VADOutputs

SURE = 0.5  # lines and vehicles with lower scores constrain nothing
BOUNDARY_M = 1.0  # places keep this distance from boundaries
NEAR_M = 3.0  # vehicles further away cannot be hit
ACROSS_M, ALONG_M = 1.5, 3.0  # distance to vehicles, across and along the lane
LANE_M = 2.0  # dividers up to this distance give the direction
MOVED_M = 1.0  # a shorter path has no direction
CLOSED_M = 0.01  # a line whose ends are so near to each other is closed
SHORTEST_M = 0.5  # shorter rests of lines that the range cuts are left out


@dataclass(frozen=True)
class FrameTruth:
    """The ground truth of one frame, bev frame.

    Attributes:
        boxes: the G boxes to be found, each with one future of T steps; NaN from the step on in which the object is
            not there.
        lines: of the map.
        driven: (T, 2) places where the vehicle was at the same times, metres; NaN after the end of the scene.
        command: the driver's command that the driven path follows; "" where no place is known.
    """

    boxes: Boxes3D
    lines: MapLines
    driven: Array
    command: str


def missing_truth(frame: Frame, config: VADConfig) -> tuple[str, str] | None:
    """The truth beyond boxes that a frame lacks, in words, and its file; None where nothing is missing."""
    return ("lines", TRUE_LINES) if result_of(MapLines, frame.ground_truth_results) is None else None


def frame_truth(frame: Frame, sequence: Drive, index: int, config: VADConfig) -> FrameTruth:
    """The truth of a frame that a model trains on.

    frame: with ground truth boxes, and the rig that the model sees; at `index` of its drive, `sequence`.
    Raises InputError where the frame has no true lines, or its objects have no identities.
    """
    assert frame.ground_truth is not None
    times, boxes = config.future_times_s, frame.ground_truth
    lines = result_of(MapLines, frame.ground_truth_results)
    if lines is None:
        raise InputError(
            f"frame {frame.stamp.index} of {frame.stamp.scene or 'the drive'} has no true lines of the map: training "
            f"{config.name} needs {TRUE_LINES} (bevcli render writes it)"
        )
    later = FramesByTime(_frames_until(sequence, index, max(times)))
    bev_from_world = inverse(frame.world_from_ego.matrix @ frame.rig.ego_from_bev)
    boxes = with_true_futures(boxes, frame.stamp, later, times)
    driven = np.full((len(times), 2), np.nan)
    for step, seconds in enumerate(times):
        future = later.after(frame.stamp, seconds)
        if future is not None and future.world_from_ego is not None:
            driven[step] = apply(bev_from_world, (future.world_from_ego.matrix @ frame.rig.ego_from_bev)[:3, 3])[:2]
    boxes = boxes_inside(boxes.transformed(bev_from_world), config)
    known = driven[np.isfinite(driven).all(-1)]
    return FrameTruth(boxes, lines, driven, followed(known, config.commands) if len(known) else "")


def _frames_until(sequence: Drive, index: int, seconds: float) -> Iterator[FrameBoxes]:
    """The frames of the same scene from an index on, and up to so many seconds later."""
    now = sequence.stamps[index]
    last_ns = now.timestamp_ns + round((seconds + LATE_S) * 1e9)
    for later, stamp in enumerate(sequence.stamps):
        if stamp.scene == now.scene and now.timestamp_ns <= stamp.timestamp_ns <= last_ns:
            frame = sequence.ground_truth_frame(later)
            boxes = Boxes3D.empty() if frame.ground_truth is None else frame.ground_truth
            yield FrameBoxes(stamp, frame.world_from_ego, boxes)


def head_losses(
    outputs: VADOutputs, truths: Sequence[FrameTruth], matches: Sequence[tuple[Tensor, Tensor]], config: VADConfig
) -> dict[str, Tensor]:
    """The weighted scalar losses of lines, futures and paths by name.

    truths: B. matches: of each frame the object queries that are matched to boxes, and the indices of these.
    """
    weights, grid, device = config.loss_weights, config.bev_grid, outputs.plan.device
    targets = [line_targets(truth.lines, config.line_decoder, grid, device) for truth in truths]
    losses = line_losses(outputs.lines, targets, weights, _extent(config, device))
    losses |= motion_losses(outputs.motion, [truth.boxes for truth in truths], matches, weights)
    return losses | plan_losses(outputs, truths, config)


def motion_losses(
    outputs: MotionOutputs, truths: Sequence[Boxes3D], matches: Sequence[tuple[Tensor, Tensor]], weights: LossWeights
) -> dict[str, Tensor]:
    """The weighted scalar losses, divided by the number of matched boxes whose next place is known.

    truths: B, each with one future. matches: as for `head_losses`.
    """
    mode_targets, counted = torch.zeros_like(outputs.mode_logits), torch.ones_like(outputs.mode_logits)
    errors, number = outputs.offsets.new_zeros(()), 0
    for element, (boxes, (queries, objects)) in enumerate(zip(truths, matches, strict=True)):
        true = true_offsets(boxes, outputs.offsets.device)[objects]  # (K, T, 2)
        known = true.isfinite().all(-1)
        counted[element, queries[~known[:, 0]]] = 0
        queries, true, known = queries[known[:, 0]], true[known[:, 0]].nan_to_num(), known[known[:, 0]]
        modes = best_modes(outputs.offsets[element, queries], true, known)
        mode_targets[element, queries, modes] = 1
        predicted = outputs.offsets[element, queries, modes]
        errors = errors + (F.l1_loss(predicted, true, reduction="none") * known[..., None]).sum()
        number += len(queries)
    classes = (focal_loss(outputs.mode_logits, mode_targets) * counted).sum()
    return {"futures": weights.future * errors / max(number, 1), "modes": weights.mode * classes / max(number, 1)}


def true_offsets(boxes: Boxes3D, device: torch.device) -> Tensor:
    """(G, T, 2) movement of each box in each step, metres; NaN if unknown. The boxes have one future each."""
    assert boxes.futures is not None
    places = np.concatenate([boxes.centers[:, None, :2], boxes.futures[:, 0, :, 1:]], axis=1)
    return torch.tensor(np.diff(places, axis=1), dtype=torch.float32, device=device)


@torch.no_grad()
def best_modes(offsets: Tensor, true: Tensor, known: Tensor) -> Tensor:
    """(K,) the mode that is nearest to the true place in the last known step.

    Args:
        offsets: (K, M, T, 2).
        true: (K, T, 2), zero where unknown.
        known: (K, T) bool, true from the first step to the last known one.
    """
    summed = ((offsets - true[:, None]) * known[:, None, :, None]).sum(2)  # (K, M, 2) error of the last known place
    return summed.norm(dim=-1).argmin(-1)


def plan_losses(outputs: VADOutputs, truths: Sequence[FrameTruth], config: VADConfig) -> dict[str, Tensor]:
    """The weighted scalar losses of the paths of the commands that were followed.

    Each is the mean over frames and steps; unknown steps count as zero. As published, the mean of the distances is
    also over the paths of the other commands, which count as zero, and over x and y.
    """
    weights, totals, commands = config.loss_weights, outputs.plan.new_zeros(4), config.commands
    for element, truth in enumerate(truths):
        if truth.command in commands:
            offsets = outputs.plan[element, commands.index(truth.command)]  # (T, 2)
            totals = totals + path_losses(offsets, truth, *scene_of(outputs, element, config)) / len(truths)
    shares = totals.new_tensor([weights.plan / len(commands), weights.boundary, weights.collision, weights.direction])
    names = ("plan", "plan boundaries", "plan collisions", "plan directions")
    return dict(zip(names, totals * shares, strict=True))


def path_losses(offsets: Tensor, truth: FrameTruth, boundaries: Tensor, dividers: Tensor, vehicles: Tensor) -> Tensor:
    """(4,) mean L1 distance of the movements (T, 2), and the means of the constraints. The others: see `scene_of`."""
    driven = torch.tensor(truth.driven, dtype=torch.float32, device=offsets.device)
    true = torch.cat([driven.new_zeros(1, 2), driven]).diff(dim=0)
    known, path = true.isfinite().all(-1), offsets.cumsum(0)
    errors = (offsets - true.nan_to_num()).abs().mean(-1)
    along, apart = direction_loss(path, dividers), collision_loss(path, vehicles).mean(-1)
    return (torch.stack([errors, boundary_loss(path, boundaries), apart, along]) * known).mean(-1)


@torch.no_grad()
def scene_of(outputs: VADOutputs, element: int, config: VADConfig) -> tuple[Tensor, Tensor, Tensor]:
    """The surroundings of a frame as the model sees them, bev frame, metres.

    Boundaries (L, P, 2), dividers (D, P, 2), and places of vehicles in their best futures (V, T, 2).
    """
    start = torch.tensor([config.bev_grid.x_range_m[0], config.bev_grid.y_range_m[0]], device=outputs.plan.device)
    lines = outputs.lines.points[-1, element] * _extent(config, start.device) + start  # (N, P, 2)
    scores, classes = outputs.lines.class_logits[-1, element].sigmoid(), config.line_decoder.classes

    def sure(name: str) -> Tensor:
        return lines[scores[:, classes.index(name)] >= SURE] if name in classes else lines[:0]

    best, labels = outputs.class_logits[-1, element].sigmoid().max(-1)  # (Q,)
    is_vehicle = torch.tensor([kind.vehicle for kind in config.object_classes.values()], device=start.device)
    seen = (best >= SURE) & is_vehicle[labels]
    modes = outputs.motion.mode_logits[element, seen].argmax(-1)
    offsets = outputs.motion.offsets[element, seen, modes]  # (V, T, 2)
    vehicles = outputs.box_codes[-1, element, seen, None, :2] + offsets.cumsum(1)
    return sure(BOUNDARY), sure(DIVIDER), vehicles


def _extent(config: VADConfig, device: torch.device) -> Tensor:
    """(2,) of the range in x and y, metres."""
    (x0, x1), (y0, y1) = config.bev_grid.x_range_m, config.bev_grid.y_range_m
    return torch.tensor([x1 - x0, y1 - y0], device=device)


def boundary_loss(path: Tensor, boundaries: Tensor) -> Tensor:
    """(T,) metres by which the places of a path (T, 2) are nearer than BOUNDARY_M to a point of a boundary.

    From the step on that crosses the nearest boundary it is zero: the gradient would lead further away.
    """
    if not len(boundaries):
        return path.new_zeros(len(path))
    distances = (path[:, None, None] - boundaries).norm(dim=-1)  # (T, L, P)
    nearest = boundaries[distances.amin(-1).argmin(-1)]  # (T, P, 2)
    starts = torch.cat([path.new_zeros(1, 2), path[:-1]]).detach()
    crossed = crosses(starts, path.detach(), nearest).cumsum(0) > 0
    return (BOUNDARY_M - distances.amin((-1, -2))).relu() * ~crossed


def crosses(starts: Tensor, ends: Tensor, lines: Tensor) -> Tensor:
    """(T,) whether the segment from start to end, both (T, 2), meets a segment of the line (T, P, 2) of its row."""
    step, sides = (ends - starts)[:, None], lines.diff(dim=1)  # (T, 1, 2), (T, P - 1, 2)
    between = lines[:, :-1] - starts[:, None]
    area = _cross(step, sides)
    along, on_line = _cross(between, sides) / area, _cross(between, step) / area
    return ((area != 0) & (along >= 0) & (along <= 1) & (on_line >= 0) & (on_line <= 1)).any(-1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def collision_loss(path: Tensor, vehicles: Tensor) -> Tensor:
    """(T, 2) metres by which the places of a path (T, 2) are too near to a vehicle, in x and in y.

    vehicles: (V, T, 2).
    """
    if not len(vehicles):
        return torch.zeros_like(path)
    apart = path - vehicles  # (V, T, 2)
    is_far = apart.norm(dim=-1, keepdim=True) > NEAR_M
    return (path.new_tensor([ACROSS_M, ALONG_M]) - apart.abs().masked_fill(is_far, torch.inf).amin(0)).relu()


def direction_loss(path: Tensor, dividers: Tensor) -> Tensor:
    """(T,) angle, 0 to pi/2, between the steps of a path (T, 2) and the nearest divider; 0 where none is near."""
    if not len(dividers) or (path[-1] - path[0]).norm() < MOVED_M:
        return path.new_zeros(len(path))
    distances = (path.detach()[:, None, None] - dividers).norm(dim=-1)  # (T, D, P)
    near, line = distances.amin(-1).min(-1)
    points, steps = dividers[line], torch.arange(len(path), device=path.device)  # (T, P, 2)
    segment = distances[steps, line].argmin(-1).clamp(max=points.shape[1] - 2)
    along = points[steps, segment + 1] - points[steps, segment]
    moved = torch.cat([path.diff(dim=0), path.diff(dim=0)[-1:]])
    angles = torch.atan2(_cross(moved, along).abs(), (moved * along).sum(-1).abs())
    return angles * (near <= LANE_M)


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
    class_targets, matched, true = torch.zeros_like(logits), [], []
    for element, truth in enumerate(targets):
        costs, best = matching_costs(logits[element], points[element], truth, weights)
        queries, lines = hungarian_matching(costs)
        class_targets[element, queries, truth.labels[lines]] = 1
        matched.append(points[element, queries])
        true.append(truth.orders[lines, best[queries, lines]])
    at, wanted = torch.cat(matched), torch.cat(true)  # (K, P, 2)
    classes = weights.line_class * focal_loss(logits, class_targets).sum()
    distances = weights.line_points * F.l1_loss(at, wanted, reduction="sum")
    segments, true_segments = (points.diff(dim=1) * extent_m for points in (at, wanted))
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


HEADS = OwnHeads(missing_truth, frame_truth, head_losses)
