"""Deformable attention on the CPU by compiled loops, which write each sum once and hold no sampled values."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from bevcli.model.row_threads import in_threads


def sample_compiled(
    values: Tensor,
    level_shapes: Sequence[tuple[int, int]],
    locations: Tensor,
    weights: Tensor,
    queries_per_map: Sequence[int],
) -> Tensor:
    """As `deformable_attention`; tensors on the CPU, no gradients."""
    from bevcli.model.bilinear_kernels import sample_maps  # loads the compiler, which not every run needs

    shapes = np.asarray(level_shapes, dtype=np.int64)
    map_of_query = np.repeat(np.arange(len(values)), queries_per_map)
    out = torch.empty(len(locations), *values.shape[2:])
    arrays = (as_array(values), shapes, as_array(locations.float()), as_array(weights.float()), map_of_query)
    in_threads(partial(sample_maps, *arrays, out.numpy()), len(locations))
    return out.flatten(1)


def load_compiled(dtype: torch.dtype) -> None:
    """Loads the compiler and the loops for values of float32 and of a dtype; the first call would wait for it."""
    for values in (torch.zeros(1, 1, 1, 1), torch.zeros(1, 1, 1, 1, dtype=dtype)):
        sample_compiled(values, [(1, 1)], torch.zeros(1, 1, 1, 1, 2), torch.zeros(1, 1, 1, 1), [1])


def as_array(tensor: Tensor) -> np.ndarray:
    """A view for compiled loops, of a copy where the layout asks for it; bfloat16 as its bits, float16 as float32."""
    tensor = tensor.detach().contiguous()
    if tensor.dtype == torch.bfloat16:
        return tensor.view(torch.int16).numpy().view(np.uint16)
    return tensor.float().numpy()
