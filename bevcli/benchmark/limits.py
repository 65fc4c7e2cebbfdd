"""What the machine can do at most, measured: the rate of matrix products and the rate of copying memory."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from bevcli.model.prepared import DTYPES, Precision

# Edge of the square matrices and floats of the copied block: large enough for full speed, small enough to be quick.
CPU_EDGE, GPU_EDGE = 2048, 8192
COPIED_FLOATS = 1 << 26
REPEATS = 8


@dataclass(frozen=True)
class MachineLimits:
    """gemm_gflops: of matrix products, 10^9 operations a second. copy_gbs: 10^9 bytes a second, read plus written."""

    gemm_gflops: float
    copy_gbs: float

    def fastest(self, other: MachineLimits) -> MachineLimits:
        """The higher of two measurements: disturbances only slow down."""
        return MachineLimits(max(self.gemm_gflops, other.gemm_gflops), max(self.copy_gbs, other.copy_gbs))


def measure_limits(device: torch.device, precision: Precision) -> MachineLimits:
    """Best of some matrix products at that precision, and of some copies, on a device."""
    edge = GPU_EDGE if device.type == "cuda" else CPU_EDGE
    matrix = torch.randn(edge, edge, device=device).to(DTYPES[precision])
    product = torch.empty_like(matrix)
    source, target = (torch.ones(COPIED_FLOATS, device=device) for _ in range(2))
    gemm_s = _best_seconds(lambda: torch.mm(matrix, matrix, out=product), device)
    copy_s = _best_seconds(lambda: target.copy_(source), device)
    return MachineLimits(2 * edge**3 / gemm_s / 1e9, 2 * 4 * COPIED_FLOATS / copy_s / 1e9)


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


def wait_for(device: torch.device) -> None:
    """Returns once a GPU has done all that it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
