"""Deformable attention on the CPU by compiled loops, which hold no sampled values."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bevcli.model.kernels.threads import in_threads


def sample_compiled(
    values: Tensor,
    level_shapes: Sequence[tuple[int, int]],
    locations: Tensor,
    weights: Tensor,
    queries_per_map: Sequence[int],
) -> Tensor:
    """As `deformable_attention`; tensors on the CPU. Gradients are those of values in float32."""
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (values, locations, weights)):
        values = values.float()
    return _CompiledSampling.apply(values, locations.float(), weights.float(), level_shapes, queries_per_map)


class _CompiledSampling(torch.autograd.Function):
    """The sums and their gradients, the latter for values in float32; for neither, a sampled value is held."""

    @staticmethod
    def forward(
        context: Any,
        values: Tensor,
        locations: Tensor,
        weights: Tensor,
        level_shapes: Sequence[tuple[int, int]],
        queries_per_map: Sequence[int],
    ) -> Tensor:
        from bevcli.model.kernels.bilinear import sample_maps  # loads the compiler, which not every run needs

        context.save_for_backward(values, locations, weights)
        context.level_shapes, context.queries_per_map = level_shapes, queries_per_map
        shapes = np.asarray(level_shapes, dtype=np.int64)
        map_of_query = np.repeat(np.arange(len(values)), queries_per_map)
        out = torch.empty(len(locations), *values.shape[2:])
        arrays = (as_array(values), shapes, as_array(locations), as_array(weights), map_of_query)
        in_threads(partial(sample_maps, *arrays, out.numpy()), len(locations))
        return out.flatten(1)

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        from bevcli.model.kernels.bilinear import sample_maps_backward

        values, locations, weights = context.saved_tensors
        found = torch.zeros(values.shape), torch.empty(locations.shape), torch.empty(weights.shape)
        above = gradients[0].unflatten(-1, values.shape[2:])
        shapes = np.asarray(context.level_shapes, dtype=np.int64)
        starts = np.cumsum([0, *context.queries_per_map])
        read = (as_array(values), shapes, as_array(locations), as_array(weights), starts, as_array(above))
        written = [tensor.numpy() for tensor in found]
        heads_of_maps = values.shape[0] * values.shape[2]
        in_threads(partial(sample_maps_backward, *read, *written), heads_of_maps, min_range=1)
        return (*found, None, None)


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
