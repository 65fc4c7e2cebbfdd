"""The arithmetic operations of a frame, counted."""

import math
from typing import Any

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from bevcli.model.bevformer.bevformer import BEVFormer, EncoderInputs
from bevcli.model.bevformer_v2.bevformer_v2 import BEVFormerV2
from bevcli.model.config import ModelConfig
from bevcli.model.network import build_network
from bevcli.model.pillar_projection import PillarHits
from bevcli.registry import for_model

# Bilinear sampling: a product and a sum for each of four neighbours, then a product and a sum with the weight.
OPERATIONS_PER_SAMPLE = 4 * 2 + 2


def count_operations(config: ModelConfig, hits_per_camera: tuple[int, ...]) -> float:
    """Arithmetic operations of one frame with history; a multiplication and an addition are two.

    Counts matrix products, convolutions, attention and sampling of the plain model, from the shapes alone.
    hits_per_camera: number of BEV cells that each camera sees.
    """
    counter = FlopCounterMode(display=False, custom_mapping={torch.ops.aten.grid_sampler_2d: _sampling_operations})
    grid, cameras, total = config.bev_grid, len(hits_per_camera), sum(hits_per_camera)
    with torch.device("meta"), counter:
        model = build_network(config).eval().requires_grad_(False)
        width, height = config.image.padded_size
        hits = PillarHits(
            cell=torch.zeros(total, dtype=torch.int64),
            reference_points=torch.empty(total, grid.pillar_points, 2),
            hits_per_camera=hits_per_camera,
            cameras_per_cell=torch.ones(grid.rows * grid.columns, dtype=torch.int64),
        )
        images, camera_index = torch.empty(1, cameras, 3, height, width), torch.zeros(cameras, dtype=torch.int64)
        for run in for_model("operations", type(model)):
            run(model, images, camera_index, hits)
    return float(counter.get_total_flops())


def run_recurrent_frame(model: BEVFormer, images: Tensor, camera_index: Tensor, hits: PillarHits) -> None:
    """A frame with history, for a network on the device "meta".

    images: (1, N, 3, H, W). camera_index: (N,). hits: as in a real frame.
    """
    history = torch.empty(1, *model.bev_queries.embedding.shape)
    can_bus, shift, rotation = torch.empty(1, 18), torch.empty(1, 2), torch.empty(1, 2, 3)
    model.compute(EncoderInputs(images, camera_index, can_bus, shift, hits, None, history, rotation))


def run_window(model: BEVFormerV2, images: Tensor, camera_index: Tensor, hits: PillarHits) -> None:
    """See `run_recurrent_frame`. Every frame of the window is encoded anew; its images were seen before."""
    features, frames = model.image_features(images, camera_index), len(model.config.frames)
    model.compute(((features, hits),) * frames, range(frames))


def _sampling_operations(*_shapes: Any, out_shape: Any, **_options: Any) -> int:
    return OPERATIONS_PER_SAMPLE * math.prod(out_shape)
