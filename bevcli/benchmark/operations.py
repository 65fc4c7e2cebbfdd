"""How many arithmetic operations a frame takes: counted on shapes alone, nothing is computed."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from bevcli.model.bevformer import BEVFormer, BEVFormerConfig
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.pillar_projection import PillarHits

# Bilinear sampling: of each of four neighbours a product and a sum; the sampled value then times its weight.
OPERATIONS_A_SAMPLE = 4 * 2 + 2


def count_operations(config: BEVFormerConfig, hits_per_camera: tuple[int, ...]) -> float:
    """Operations (a multiplication and an addition are two) of one frame with history.

    Matrix products, convolutions, attention and sampling of the model as the paper has it, spatial cross-attention
    over the given numbers of hits, one a camera.
    """
    counter = FlopCounterMode(display=False, custom_mapping={torch.ops.aten.grid_sampler_2d: _sampling})
    with torch.device("meta"), counter:
        model = BEVFormer(config).eval().requires_grad_(False)
        width, height = config.image.padded_size
        maps = model.neck(model.backbone(torch.empty(len(hits_per_camera), 3, height, width)))
        tokens = model.image_tokens(maps, torch.zeros(len(hits_per_camera), dtype=torch.int64))
        bev = _encode(model, tokens, hits_per_camera)
        model.decoder(bev, model.detection_head)
    return float(counter.get_total_flops())


def _encode(model: BEVFormer, tokens: FeatureMaps, hits_per_camera: tuple[int, ...]) -> torch.Tensor:
    grid, total = model.config.bev_grid, sum(hits_per_camera)
    hits = PillarHits(
        cell=torch.zeros(total, dtype=torch.int64),
        reference_points=torch.empty(total, grid.pillar_points, 2),
        hits_per_camera=hits_per_camera,
        cameras_per_cell=torch.ones(grid.rows * grid.columns, dtype=torch.int64),
    )
    query = model.bev_queries(torch.empty(1, 18))
    history = torch.empty(1, grid.rows * grid.columns, model.config.channels)
    return model.encoder(query, model.bev_queries.position(), tokens, hits, history, torch.empty(1, 2))


def _sampling(*_shapes: Any, out_val: Any = None, out_shape: Any = None, **_options: Any) -> int:
    shape = out_val.shape if out_val is not None else out_shape
    return OPERATIONS_A_SAMPLE * math.prod(shape)
