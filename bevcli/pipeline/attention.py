"""From the model's attention samples to what can be drawn: metres in the BEV, pixels in the images as read."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from bevcli.errors import InputError
from bevcli.frame import AttentionView, CameraSamples, Probe
from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.attention_probe import AttentionProbe, SpatialSamples
from bevcli.model.bevformer import BEVFormerConfig
from bevcli.pipeline.preprocess import PreparedFrame


def probe_cells(probes: tuple[tuple[float, float], ...], grid: BevGrid) -> Tensor:
    """(K,) int64 indices of the cells at K places (x, y) in metres, bev frame. Raises InputError outside the grid."""
    cells = []
    for x, y in probes:
        row, column = grid.cell_of((x, y))
        if row < 0:
            (x0, x1), (y0, y1) = grid.x_range_m, grid.y_range_m
            raise InputError(f"--probe {x:g},{y:g}: outside the BEV map (x {x0:g} to {x1:g} m, y {y0:g} to {y1:g} m)")
        cells.append(row * grid.columns + column)
    return torch.tensor(cells, dtype=torch.int64)


def attention_view(probe: AttentionProbe, prepared: PreparedFrame, config: BEVFormerConfig) -> AttentionView:
    """The answers of a probe, one frame (batch of one)."""
    grid = config.bev_grid
    share = probe.history_share
    history = None if share is None else share[0].float().cpu().double().numpy().reshape(grid.rows, grid.columns)
    centers = grid.cell_centers().reshape(-1, 2)
    cells = probe.cells.tolist()
    probes = tuple(Probe(centers[cell], _samples(probe.spatial, cell, prepared, config)) for cell in cells)
    return AttentionView(history_weight=history, probes=probes)


def _samples(
    samples: SpatialSamples | None, cell: int, prepared: PreparedFrame, config: BEVFormerConfig
) -> dict[str, CameraSamples]:
    if samples is None:
        return {}
    chosen = (samples.cell == cell).nonzero()[:, 0].tolist()
    size = np.array(config.image.padded_size, dtype=np.float64)
    result = {}
    for row in chosen:
        place = int(samples.camera[row])
        camera = prepared.frame.rig[prepared.assignment.cameras[place]]
        pixels = samples.locations[row].float().cpu().double().numpy().reshape(-1, 2) * size / prepared.scales[place]
        weights = samples.weights[row].float().cpu().double().numpy().reshape(-1)
        shares = weights / (len(chosen) * samples.weights.shape[1])  # of all heads and cameras together
        result[camera.name] = CameraSamples(camera.distorted(pixels), shares)
    return result
