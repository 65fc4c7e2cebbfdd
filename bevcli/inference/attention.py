"""The attention of an encoder layer, observed in the model and converted to BEV cells and pixels for display."""

import math
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bevcli.errors import InputError
from bevcli.frame import AttentionView, CameraSamples, Probe
from bevcli.geometry.bev_grid import BevGrid
from bevcli.inference.preprocess import resize_shift
from bevcli.model.config import ModelConfig
from bevcli.model.encoder import EncoderLayer
from bevcli.model.pillar_projection import PillarHits
from bevcli.model.step import PreparedFrame
from bevcli.model.temporal_model import TemporalModel


@dataclass(frozen=True)
class SpatialSamples:
    """The samples of K' pairs of a camera and a cell in spatial cross-attention."""

    camera: Tensor  # (K',) index in B·N
    cell: Tensor  # (K',) index in B·Y·X
    locations: Tensor  # (K', heads, L, P, 2) x, y, 0 to 1 over the padded image
    weights: Tensor  # (K', heads, L, P), whose sum is 1 for each head


class AttentionProbe(ExitStack):
    """Observes the attentions of one encoder layer, in a plain or a prepared model.

    Forward hooks read the inputs and outputs of the layer's parts. They exist inside the `with` block only:

        with AttentionProbe(model, layer=5, cells=torch.tensor([20_100])) as probe:
            model(inputs, history)
        probe.spatial, probe.history_share

    Attributes:
        cells: (K,) int64, the cells (index in B·Y·X) whose samples are kept.
        spatial: samples of spatial cross-attention, None before the model has run.
        history_share: (B, Y·X), 0 to 1, the share of the history map in what temporal self-attention sampled, by the
            norms of the two sampled vectors; None without history. The attention weights cannot tell, because each
            map has a softmax of its own and the two results are averaged.
    """

    def __init__(self, model: TemporalModel, layer: int, cells: Tensor) -> None:
        super().__init__()
        self.cells = cells
        self.spatial: SpatialSamples | None = None
        self.history_share: Tensor | None = None
        observed = model.get_submodule(f"encoder.layers.{layer}")
        assert isinstance(observed, EncoderLayer)
        self._layer = observed

    def __enter__(self) -> "AttentionProbe":
        temporal, spatial = self._layer.temporal_self_attention, self._layer.spatial_cross_attention
        for module, see in (
            (temporal.attention.sampling, self._see_temporal_samples),
            (spatial.attention.sampling, self._see_spatial_samples),
            (spatial, self._see_hits),
        ):
            self.enter_context(module.register_forward_hook(see))
        for sampling in (temporal.attention.sampling, spatial.attention.sampling):
            self.callback(setattr, sampling, "sample_hits", sampling.sample_hits)
            sampling.sample_hits = None  # which computes no locations
        return self

    def _see_temporal_samples(self, _module: object, arguments: tuple[Any, ...], sampled: Tensor) -> None:
        cells = math.prod(arguments[1][0])  # of the one level, the BEV map
        if arguments[4][0] > cells:  # without history both maps are the current one
            return
        norms = sampled.detach().unflatten(0, (-1, 2, cells)).norm(dim=-1)  # (B, 2, Y·X)
        self.history_share = norms[:, 0] / norms.sum(1).clamp(min=1e-12)

    def _see_spatial_samples(self, _module: object, arguments: tuple[Any, ...], _sampled: Tensor) -> None:
        self._locations, self._weights = arguments[2].detach(), arguments[3].detach()

    def _see_hits(self, _module: object, arguments: tuple[Any, ...], _attended: Tensor) -> None:
        hits: PillarHits = arguments[2]
        counts = torch.tensor(hits.hits_per_camera, device=hits.cell.device)
        camera = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
        shown = torch.isin(hits.cell, self.cells) & hits.is_seen
        self.spatial = SpatialSamples(camera[shown], hits.cell[shown], self._locations[shown], self._weights[shown])


def probe_cells(probes: tuple[tuple[float, float], ...], grid: BevGrid) -> Tensor:
    """(K,) int64 indices of the cells at K positions (x, y) in metres, bev frame.

    Raises InputError for a position outside the grid.
    """
    cells = []
    for x, y in probes:
        row, column = grid.cell_of((x, y))
        if row < 0:
            (x0, x1), (y0, y1) = grid.x_range_m, grid.y_range_m
            raise InputError(
                f"`probes=({x:g}, {y:g})` (`--probe`): outside the BEV map (x {x0:g} to {x1:g} m, y {y0:g} to {y1:g} m)"
            )
        cells.append(row * grid.columns + column)
    return torch.tensor(cells, dtype=torch.int64)


def attention_view(probe: AttentionProbe, prepared: PreparedFrame, config: ModelConfig) -> AttentionView:
    """The observations of a probe in one frame (a batch of one), in BEV cells and in pixels of the images as read."""
    grid = config.bev_grid
    share = probe.history_share
    history = None if share is None else share[0].float().cpu().double().numpy().reshape(grid.rows, grid.columns)
    centers = grid.cell_centers().reshape(-1, 2)
    cells = probe.cells.tolist()
    probes = tuple(Probe(centers[cell], _samples(probe.spatial, cell, prepared, config)) for cell in cells)
    return AttentionView(history_weight=history, probes=probes)


def _samples(
    samples: SpatialSamples | None, cell: int, prepared: PreparedFrame, config: ModelConfig
) -> dict[str, CameraSamples]:
    """The samples of a cell by camera; no entry for a camera that does not see it."""
    if samples is None:
        return {}
    rows = (samples.cell == cell).nonzero()[:, 0].tolist()
    size = np.array(prepared.images.shape[:-3:-1], dtype=np.float64)  # (width, height)
    result = {}
    for row in rows:
        index = int(samples.camera[row])
        camera = prepared.frame.rig[prepared.assignment.cameras[index]]
        network_pixels = samples.locations[row].float().cpu().double().numpy().reshape(-1, 2) * size
        scale = prepared.scales[index]
        pixels = (network_pixels + config.image.crop_box[:2] - resize_shift(scale, config.image)) / scale
        weights = samples.weights[row].float().cpu().double().numpy().reshape(-1)
        shares = weights / (len(rows) * samples.weights.shape[1])  # the sum over all heads and cameras is 1
        result[camera.name] = CameraSamples(camera.distorted(pixels), shares)
    return result
