"""Modulated deformable convolution on the CPU: compiled sampling and a matrix product, tile after tile."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from bevcli.model.kernels.compiled_attention import as_array
from bevcli.model.kernels.threads import in_threads

# Unfolded rows of one tile: large enough for a matrix product at full speed, small enough to stay in the cache.
TILE_BYTES = 8 << 20


def convolve_compiled(
    x: Tensor, offsets: Tensor, mask: Tensor, product: Callable[[Tensor], Tensor], out_channels: int, stride: int
) -> Tensor:
    """As `modulated_deformable_convolution`; on the CPU, no gradients. Returns channels-last.

    product: (rows, 9 · C), a row's nine taps one after another -> (rows, O).
    """
    from bevcli.model.kernels.bilinear import sample_taps  # loads the compiler, which not every run needs

    batch, channels = x.shape[:2]
    height, width = mask.shape[-2:]
    rows = batch * height * width
    tile = min(rows, max(64, TILE_BYTES // (9 * channels * x.element_size())))
    arrays = (
        as_array(x.permute(0, 2, 3, 1)),
        as_array(offsets.float().permute(0, 3, 4, 1, 2)),
        as_array(mask.float().permute(0, 2, 3, 1)),
    )
    # The compiled loops write bfloat16 and float32.
    taps = torch.empty(tile, 9, channels, dtype=torch.bfloat16 if x.dtype == torch.bfloat16 else torch.float32)
    out = x.new_empty(rows, out_channels)

    for first in range(0, rows, tile):
        count = min(tile, rows - first)
        in_threads(partial(sample_taps, *arrays, stride, first, as_array(taps)), count)
        out[first : first + count] = product(taps[:count].flatten(1).to(x.dtype))
    return out.view(batch, height, width, -1).permute(0, 3, 1, 2)
