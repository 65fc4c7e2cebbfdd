"""The losses of VAD's own heads."""

from collections.abc import Sequence

import torch
from torch import Tensor

from bevcli.frame import LINE_CLASSES
from bevcli.model.truth import FrameTruth
from bevcli.model.vad.config import VADConfig
from bevcli.model.vad.decoding import VADOutputs
from bevcli.model.vad.line_loss import line_losses, line_targets
from bevcli.model.vad.motion_loss import motion_losses
from bevcli.model.vad.plan_loss import SURE, Scene, boundary_loss, collision_loss, direction_loss

DIVIDER, _, BOUNDARY = LINE_CLASSES


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


def plan_losses(outputs: VADOutputs, truths: Sequence[FrameTruth], config: VADConfig) -> dict[str, Tensor]:
    """The weighted scalar losses of the paths of the commands that were followed.

    Each is the mean over frames and steps; unknown steps count as zero. As published, the mean of the distances is
    also over the paths of the other commands, which count as zero, and over x and y.
    """
    weights, totals, commands = config.loss_weights, outputs.plan.new_zeros(4), config.commands
    for element, truth in enumerate(truths):
        if truth.command in commands:
            offsets = outputs.plan[element, commands.index(truth.command)]  # (T, 2)
            totals = totals + path_losses(offsets, truth, scene_of(outputs, element, config)) / len(truths)
    shares = totals.new_tensor([weights.plan / len(commands), weights.boundary, weights.collision, weights.direction])
    names = ("plan", "plan boundaries", "plan collisions", "plan directions")
    return dict(zip(names, totals * shares, strict=True))


def path_losses(offsets: Tensor, truth: FrameTruth, scene: Scene) -> Tensor:
    """(4,) mean L1 distance of the movements, and the means of the constraints."""
    driven = torch.tensor(truth.driven, dtype=torch.float32, device=offsets.device)
    true = torch.cat([driven.new_zeros(1, 2), driven]).diff(dim=0)
    known, path = true.isfinite().all(-1), offsets.cumsum(0)
    errors = (offsets - true.nan_to_num()).abs().mean(-1)
    boundaries, collisions = boundary_loss(path, scene.boundaries), collision_loss(path, scene.vehicles).mean(-1)
    return (torch.stack([errors, boundaries, collisions, direction_loss(path, scene.dividers)]) * known).mean(-1)


@torch.no_grad()
def scene_of(outputs: VADOutputs, element: int, config: VADConfig) -> Scene:
    """The surroundings of a frame as the model sees them."""
    start = torch.tensor([config.bev_grid.x_range_m[0], config.bev_grid.y_range_m[0]], device=outputs.plan.device)
    lines = outputs.lines.points[-1, element] * _extent(config, start.device) + start  # (N, P, 2)
    scores, classes = outputs.lines.class_logits[-1, element].sigmoid(), config.line_decoder.classes

    def sure(name: str) -> Tensor:
        return lines[scores[:, classes.index(name)] >= SURE] if name in classes else lines[:0]

    best, labels = outputs.class_logits[-1, element].sigmoid().max(-1)  # (Q,)
    is_vehicle = torch.tensor([one.vehicle for one in config.object_classes.values()], device=start.device)
    seen = (best >= SURE) & is_vehicle[labels]
    modes = outputs.motion.mode_logits[element, seen].argmax(-1)
    offsets = outputs.motion.offsets[element, seen, modes]  # (V, T, 2)
    vehicles = outputs.box_codes[-1, element, seen, None, :2] + offsets.cumsum(1)
    return Scene(sure(BOUNDARY), sure(DIVIDER), vehicles)


def _extent(config: VADConfig, device: torch.device) -> Tensor:
    """(2,) of the range in x and y, metres."""
    (x0, x1), (y0, y1) = config.bev_grid.x_range_m, config.bev_grid.y_range_m
    return torch.tensor([x1 - x0, y1 - y0], device=device)
