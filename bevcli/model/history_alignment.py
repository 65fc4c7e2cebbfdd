"""The history BEV map, turned by the change of the vehicle's heading."""

from __future__ import annotations

import torch
from torch import Tensor

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.ego_motion_inputs import RotationCenter

# The released code rotates about this cell at every grid size; it is the middle only of 200 x 200 cells.
ORIGINAL_ROTATION_CENTER = (100.0, 100.0)


def rotate_history(history: Tensor, rotation_deg: Tensor, grid: BevGrid, center: RotationCenter) -> Tensor:
    """history: (B, Y·X, C), rotation_deg: (B,) -> (B, Y·X, C): the nearest old cell, zero where there is none."""
    rows, columns = grid.rows, grid.columns
    row, column = _source_cells(rotation_deg, grid, center)  # (B, Y, X) each
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    source = (row.clamp(0, rows - 1) * columns + column.clamp(0, columns - 1)).flatten(1)  # (B, Y·X)
    batch = torch.arange(len(history), device=history.device)[:, None]
    return history[batch, source] * inside.flatten(1)[..., None]


def _source_cells(rotation_deg: Tensor, grid: BevGrid, center: RotationCenter) -> tuple[Tensor, Tensor]:
    """Row and column (B, Y, X) int64 of the old cell that each cell takes its history from.

    Worked out in float32 and in halves of the map, like the original's affine grid: where a source lies midway
    between two cells, the same one is taken.
    """
    half = torch.tensor([grid.columns / 2, grid.rows / 2], device=rotation_deg.device)
    angle = torch.deg2rad(rotation_deg.double())
    rotation = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], -1).unflatten(-1, (2, 2))
    pivot = torch.tensor(_center_cells(grid, center), device=half.device).double() - half
    translation = (pivot - rotation @ pivot).float() / half  # (B, 2)
    by_x, by_y = (rotation.float() / half[:, None]).unbind(-1)  # (B, 2) each
    x = torch.arange(grid.columns, device=half.device) + 0.5 - half[0]  # (X,)
    y = torch.arange(grid.rows, device=half.device) + 0.5 - half[1]  # (Y,)
    turned = [by_x[:, i, None, None] * x + by_y[:, i, None, None] * y[:, None] for i in (0, 1)]
    source_x, source_y = (part + translation[:, i, None, None] for i, part in enumerate(turned))
    row = (((source_y + 1) * grid.rows - 1) / 2).round().long()
    column = (((source_x + 1) * grid.columns - 1) / 2).round().long()
    return row, column


def _center_cells(grid: BevGrid, center: RotationCenter) -> tuple[float, float]:
    """x and y of the centre of rotation, in cells from the map's corner."""
    if center == "original":
        return ORIGINAL_ROTATION_CENTER
    if center == "center":
        return grid.columns / 2, grid.rows / 2
    return float(center[0]), float(center[1])
