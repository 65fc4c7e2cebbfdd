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
    """Row and column (B, Y, X) int64 of the old cell that each cell takes its history from."""
    center_x, center_y = _center_cells(grid, center)
    angle = torch.deg2rad(rotation_deg.double())[:, None, None]
    x = torch.arange(grid.columns, device=angle.device) + 0.5 - center_x  # (X,)
    y = (torch.arange(grid.rows, device=angle.device) + 0.5 - center_y)[:, None]  # (Y, 1)
    source_x = angle.cos() * x - angle.sin() * y + center_x - 0.5
    source_y = angle.sin() * x + angle.cos() * y + center_y - 0.5
    return source_y.round().long(), source_x.round().long()


def _center_cells(grid: BevGrid, center: RotationCenter) -> tuple[float, float]:
    """x and y of the centre of rotation, in cells from the map's corner."""
    if center == "original":
        return ORIGINAL_ROTATION_CENTER
    if center == "center":
        return grid.columns / 2, grid.rows / 2
    return float(center[0]), float(center[1])
