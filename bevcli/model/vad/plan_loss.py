"""The losses of the planned path: distance to the driven one, and the constraints of VAD (sec. 3.4).

The constraints know the scene from the model's own lines and futures, which they do not change.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

SURE = 0.5  # lines and vehicles with lower scores constrain nothing
BOUNDARY_M = 1.0  # places keep this distance from boundaries
NEAR_M = 3.0  # vehicles further away cannot be hit
ACROSS_M, ALONG_M = 1.5, 3.0  # distance to vehicles, across and along the lane
LANE_M = 2.0  # dividers up to this distance give the direction
MOVED_M = 1.0  # a shorter path has no direction


@dataclass(frozen=True)
class Scene:
    """The lines and vehicles around one planned path, bev frame, metres.

    Attributes:
        boundaries: (L, P, 2).
        dividers: (D, P, 2).
        vehicles: (V, T, 2) places of vehicles in their best futures.
    """

    boundaries: Tensor
    dividers: Tensor
    vehicles: Tensor


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
