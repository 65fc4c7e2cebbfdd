"""Deformable attention and deformable convolution on the CPU, by compiled loops that hold no sampled values."""

import contextlib
import math
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from bevcli.model.deformable_attention import GridSampling, Hits, LevelShapes
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution, split_offsets_and_mask

VECTORISED = 16  # elements from which on PyTorch's own softmax is faster
# More ranges than threads: where another process delays one thread, the others take over its ranges.
RANGES_PER_THREAD = 8
# Samples that are worth a thread's while: about half a millisecond.
SAMPLES_PER_RANGE = 1 << 15
# Sampled taps of one tile: large enough for a fast matrix product, small enough to stay in the cache.
TILE_BYTES = 8 << 20


@cache
def _loops() -> Any:
    """The module of the loops. Its import loads the compiler, which not every run needs."""
    from bevcli.model.kernels import loops

    return loops


class CompiledSampling(GridSampling):
    """A `GridSampling` on the CPU, without gradients."""

    def weights(self, logits: Tensor) -> Tensor:
        """As `GridSampling.weights`. On a CPU, PyTorch's softmax takes ten times as long for 4 or 8 samples."""
        flat = logits.flatten(-2)
        if flat.shape[-1] >= VECTORISED:
            return super().weights(logits)
        exponentials = (flat - flat.amax(-1, keepdim=True)).exp_()
        return exponentials.div_(exponentials.sum(-1, keepdim=True)).view_as(logits)

    def forward(
        self,
        values: Tensor,
        level_shapes: Sequence[tuple[int, int]],
        locations: Tensor,
        weights: Tensor,
        queries_per_map: Sequence[int],
    ) -> Tensor:
        """As `GridSampling.forward`."""
        map_of_query = np.repeat(np.arange(len(values)), queries_per_map)
        out = torch.empty(len(locations), *values.shape[2:])
        shapes = np.asarray(level_shapes, dtype=np.int64)
        arrays = (as_array(values), shapes, as_array(locations.float()), as_array(weights.float()), map_of_query)
        smallest = max(64, SAMPLES_PER_RANGE // max(math.prod(weights.shape[1:]), 1))
        in_threads(partial(_loops().sample_maps, *arrays, out.numpy()), len(locations), smallest)
        return out.flatten(1)


def sample_hits(values: Tensor, level_shapes: LevelShapes, hits: Hits, offsets: Tensor, logits: Tensor) -> Tensor:
    """The weighted sums (M, C) float32 of the M hits, without tables of their locations and weights. No gradients.

    Args:
        values: (G, S, heads, C / heads), see `GridSampling`.
        level_shapes: (height, width) of each level.
        hits: the pairs of a map and a query.
        offsets: (B·Q, heads, maps, L, P, 2) float32, in cells of a level, from the reference points.
        logits: (B·Q, heads, maps, L, P), of the weights.
    """
    map_of_hit = np.repeat(np.arange(len(values)), hits.hits_per_map)
    out = torch.empty(len(hits.query), *values.shape[2:])
    read = (as_array(values), np.asarray(level_shapes, dtype=np.int64))
    of_hits = (*map(as_array, (hits.reference_points, offsets, logits)), hits.query.numpy(), hits.prediction.numpy())
    smallest = max(64, SAMPLES_PER_RANGE // max(logits.shape[1] * math.prod(logits.shape[3:]), 1))
    in_threads(partial(_loops().sample_hits, *read, *of_hits, map_of_hit, out.numpy()), len(out), smallest)
    return out.flatten(1)


class CompiledDeformableConvolution(nn.Module):
    """Takes the place of a `ModulatedDeformableConvolution` on the CPU, with a bias and without gradients.

    The output positions are divided into tiles. For each tile, a compiled loop samples the taps, then one matrix
    product with the weight of all nine taps gives the result.
    """

    def __init__(self, convolution: ModulatedDeformableConvolution) -> None:
        """The convolution has a bias, the rest of a batch norm that was folded into it."""
        super().__init__()
        self.stride, self.out_channels = convolution.stride, len(convolution.weight)
        self.offset_and_mask = convolution.offset_and_mask
        assert convolution.bias is not None
        weight = convolution.weight.detach()  # (O, C, 3, 3)
        self.product = nn.Linear(9 * weight.shape[1], len(weight), device="meta")
        self.product.weight = nn.Parameter(weight.permute(0, 2, 3, 1).flatten(1).contiguous(), requires_grad=False)
        self.product.bias = nn.Parameter(convolution.bias.detach(), requires_grad=False)

    def forward(self, x: Tensor) -> Tensor:
        """x: (B, C, H, W) -> (B, O, H', W'), channels last."""
        offsets, mask = split_offsets_and_mask(self.offset_and_mask(x))
        batch, channels = x.shape[:2]
        height, width = mask.shape[-2:]
        rows = batch * height * width
        tile = min(rows, max(64, TILE_BYTES // (9 * channels * x.element_size())))
        arrays = (
            as_array(x.permute(0, 2, 3, 1)),
            as_array(offsets.permute(0, 3, 4, 1, 2)),
            as_array(mask.permute(0, 2, 3, 1)),
        )
        # The compiled loops write bfloat16 and float32.
        taps = torch.empty(tile, 9, channels, dtype=torch.bfloat16 if x.dtype == torch.bfloat16 else torch.float32)
        out = x.new_empty(rows, self.out_channels)
        for first in range(0, rows, tile):
            count = min(tile, rows - first)
            in_threads(partial(_loops().sample_taps, *arrays, self.stride, first, as_array(taps)), count)
            out[first : first + count] = self.product(taps[:count].flatten(1).to(x.dtype))
        return out.view(batch, height, width, -1).permute(0, 3, 1, 2)


class CompiledPool(nn.MaxPool2d):
    """Takes the place of the pooling in the stem of a ResNet, which applies ReLU to it: it gives 0 for negative maxima.

    Numbers that are not negative have the order of their bits, so that the loop compares integers.

    Attributes:
        loaded: set when the compiled loops are loaded. Until then the plain pooling runs, which need not wait.
    """

    loaded: threading.Event

    def forward(self, x: Tensor) -> Tensor:
        """x: (B, C, H, W) -> (B, C, H', W'), channels last; H' and W' are half of H and W, rounded up."""
        if not self.loaded.is_set():
            return super().forward(x)
        x = x.permute(0, 2, 3, 1).contiguous()  # (B, H, W, C)
        bits = torch.int32 if x.dtype == torch.float32 else torch.int16
        batch, height, width, channels = x.shape
        out = x.new_empty(batch, -(-height // 2), -(-width // 2), channels)
        in_threads(partial(_loops().max_of_windows, x.view(bits).numpy(), out.view(bits).numpy()), batch * out.shape[1])
        return out.permute(0, 3, 1, 2)


def load_compiled(dtype: torch.dtype, loaded: threading.Event) -> None:
    """Loads the compiler and the loops for values of float32 and of a dtype, so that the first frame need not wait.

    Raises nothing: the first frame meets the same error, in a thread that tells it. Then `loaded` is not set.
    """
    with contextlib.suppress(Exception):
        sampling, pool = CompiledSampling(), CompiledPool(3, stride=2, padding=1)
        pool.loaded = threading.Event()
        pool.loaded.set()
        location = torch.zeros(1, 1, 1, 1, 2)
        hit = Hits(torch.zeros(1, dtype=torch.int64), location[0, 0], (1,), torch.zeros(1, dtype=torch.int64))
        for values in (torch.zeros(1, 1, 1, 1), torch.zeros(1, 1, 1, 1, dtype=dtype)):
            sampling(values, [(1, 1)], location, location[..., 0], [1])
            sample_hits(values, ((1, 1),), hit, location[None], location[None, ..., 0])
        pool(torch.zeros(1, 1, 1, 1, dtype=dtype))
        loaded.set()


def as_array(tensor: Tensor) -> np.ndarray:
    """A contiguous array for compiled loops, a view where possible; bfloat16 as its bits, float16 as float32."""
    tensor = tensor.detach().contiguous()
    if tensor.dtype == torch.bfloat16:
        return tensor.view(torch.int16).numpy().view(np.uint16)
    return tensor.float().numpy()


def in_threads(work: Callable[[int, int], None], rows: int, min_range: int = 64) -> None:
    """Calls work(begin, end) for ranges that together cover 0 to rows, in as many threads as PyTorch uses.

    This thread is one of them.

    work: must release the GIL; an exception in it is raised here. min_range: rows that are worth a call of their own.
    """
    threads = torch.get_num_threads()
    step = max(min_range, -(-rows // (threads * RANGES_PER_THREAD)))
    starts = range(0, rows, step)
    if threads == 1 or len(starts) <= 1:
        work(0, rows)
        return
    remaining = iter(starts)  # gives each start to one thread

    def take_ranges() -> None:
        for start in remaining:
            work(start, min(start + step, rows))

    pool = _pool(os.getpid(), threads - 1)
    helpers = [pool.submit(take_ranges) for _ in range(min(threads, len(starts)) - 1)]
    try:
        for start in remaining:  # as the helpers
            work(start, min(start + step, rows))
    finally:
        wait(helpers)
    for helper in helpers:
        helper.result()


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """The threads of a process, which wait between calls. A forked process has none of its parent's."""
    return ThreadPoolExecutor(threads, thread_name_prefix="compiled-loops")
