"""The machine's peak throughput, measured, and the number of operations of a frame, counted."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from bevcli.model.bevformer.bevformer import BEVFormer, EncoderInputs
from bevcli.model.config import ModelConfig
from bevcli.model.network import build_network
from bevcli.model.pillar_projection import PillarHits
from bevcli.model.prepare import DTYPES, Precision
from bevcli.registry import for_model

# Edge of the square matrices and floats of the copied block: large enough for full speed, small enough to be quick.
CPU_EDGE, GPU_EDGE = 2048, 8192
COPIED_FLOATS = 1 << 26
REPEATS = 8

# Bilinear sampling: a product and a sum for each of four neighbours, then a product and a sum with the weight.
OPERATIONS_PER_SAMPLE = 4 * 2 + 2


@dataclass(frozen=True)
class MachineLimits:
    """Peak throughput.

    Attributes:
        gemm_gflops: rate of matrix products, 10^9 operations a second.
        copy_gbs: rate of copying memory, 10^9 bytes a second, read plus written.
    """

    gemm_gflops: float
    copy_gbs: float

    def fastest(self, other: "MachineLimits") -> "MachineLimits":
        """The higher of two measurements; disturbances only make a measurement lower."""
        return MachineLimits(max(self.gemm_gflops, other.gemm_gflops), max(self.copy_gbs, other.copy_gbs))


def measure_limits(device: torch.device, precision: Precision) -> MachineLimits:
    """The best of several matrix products in a precision, and of several copies, on a device."""
    edge = GPU_EDGE if device.type == "cuda" else CPU_EDGE
    matrix = torch.randn(edge, edge, device=device).to(DTYPES[precision])
    product = torch.empty_like(matrix)
    source, target = (torch.ones(COPIED_FLOATS, device=device) for _ in range(2))
    gemm_s = _best_seconds(lambda: torch.mm(matrix, matrix, out=product), device)
    copy_s = _best_seconds(lambda: target.copy_(source), device)
    return MachineLimits(2 * edge**3 / gemm_s / 1e9, 2 * 4 * COPIED_FLOATS / copy_s / 1e9)


def wait_for(device: torch.device) -> None:
    """Returns when a GPU has finished all queued work; at once on a CPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    if device.type == "mps":
        torch.mps.synchronize()


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


def _best_seconds(work: Callable[[], object], device: torch.device) -> float:
    work()
    best = float("inf")
    for _ in range(REPEATS):
        wait_for(device)
        began = time.perf_counter()
        work()
        wait_for(device)
        best = min(best, time.perf_counter() - began)
    return best


def _sampling_operations(*_shapes: Any, out_shape: Any, **_options: Any) -> int:
    return OPERATIONS_PER_SAMPLE * math.prod(out_shape)
