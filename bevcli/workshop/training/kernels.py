"""What training needs of the kernels: gradients of sampling, in a compiled loop on the CPU.

See `bevcli.model.kernels.loops` for what the functions take.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from bevcli.jit import njit
from bevcli.model.deformable_attention import DeformableAttention, GridSampling
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution
from bevcli.model.kernels.choose import change_classes, has_triton, triton_kernels
from bevcli.model.kernels.compiled import CompiledSampling, as_array, in_threads
from bevcli.model.kernels.gpu import PillarsOfCpu
from bevcli.model.network import Network
from bevcli.model.pillar_projection import Pillars


def choose_training_kernels(model: nn.Module, device: torch.device) -> None:
    """As `choose_kernels`, for a model that is trained: kernels with gradients; on a GPU, the CPU finds the hits."""
    if isinstance(model, Network):
        model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    sampling: type[GridSampling] = GridSampling
    if device.type == "cpu":
        sampling = LearnedSampling
    elif has_triton(device):
        attention, convolution = triton_kernels()
        sampling = attention.TritonSampling
        change_classes(model, {ModulatedDeformableConvolution: convolution.TritonDeformableConvolution})
    for module in model.modules():
        if isinstance(module, DeformableAttention):
            module.sampling = sampling()
    find_hits_on_cpu(model, device)


def find_hits_on_cpu(network: nn.Module, device: torch.device) -> None:
    """Lets the CPU find the hits of a network that is trained on a GPU, in place. Nothing changes on a CPU."""
    for module in network.modules() if device.type != "cpu" else ():
        if type(module) is Pillars:
            change_classes(module, {Pillars: PillarsOfCpu}, points_on_cpu=module.points.cpu())


class LearnedSampling(GridSampling):
    """A `GridSampling` on the CPU whose gradients are computed in float32."""

    def forward(
        self,
        values: Tensor,
        level_shapes: Sequence[tuple[int, int]],
        locations: Tensor,
        weights: Tensor,
        queries_per_map: Sequence[int],
    ) -> Tensor:
        """As `GridSampling.forward`."""
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (values, locations, weights)):
            learned = values.float(), locations.float(), weights.float()
            return _WeightedSums.apply(*learned, level_shapes, queries_per_map)
        return CompiledSampling()(values, level_shapes, locations, weights, queries_per_map)


class _WeightedSums(torch.autograd.Function):
    """The sums, and their gradients for values in float32."""

    @staticmethod
    def forward(
        context: Any,
        values: Tensor,
        locations: Tensor,
        weights: Tensor,
        level_shapes: Sequence[tuple[int, int]],
        queries_per_map: Sequence[int],
    ) -> Tensor:
        context.save_for_backward(values, locations, weights)
        context.level_shapes, context.queries_per_map = level_shapes, queries_per_map
        return CompiledSampling()(values, level_shapes, locations, weights, queries_per_map)  # without gradients

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        values, locations, weights = context.saved_tensors
        results = torch.zeros(values.shape), torch.empty(locations.shape), torch.empty(weights.shape)
        out_gradient = gradients[0].unflatten(-1, values.shape[2:])
        shapes = np.asarray(context.level_shapes, dtype=np.int64)
        starts = np.cumsum([0, *context.queries_per_map])
        read = (as_array(values), shapes, as_array(locations), as_array(weights), starts, as_array(out_gradient))
        written = [tensor.numpy() for tensor in results]
        heads_of_maps = values.shape[0] * values.shape[2]
        in_threads(partial(sample_maps_backward, *read, *written), heads_of_maps, min_range=1)
        return (*results, None, None)


@njit(nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def sample_maps_backward(  # type: ignore[no-untyped-def]
    values, level_shapes, locations, weights, starts, out_gradient,
    values_gradient, locations_gradient, weights_gradient, begin, end,
) -> None:  # fmt: skip
    """The gradients of `loops.sample_maps`, for units begin to end - 1; a unit is map * heads + head.

    Threads get ranges of units, not of queries, because no two units write to the same element. All arrays are
    float32, and each gradient has the shape of what it belongs to; values_gradient is added to. starts: (G + 1,) int64,
    index of each map's first query.
    """
    heads, levels, points = weights.shape[1:]
    depth = values.shape[3]
    nothing = np.zeros(depth, dtype=np.float32)
    unused = np.empty(depth, dtype=np.float32)
    one, half = np.float32(1), np.float32(0.5)
    for unit in range(begin, end):
        group, head = unit // heads, unit % heads
        tokens, tokens_gradient = values[group], values_gradient[group]
        for query in range(starts[group], starts[group + 1]):
            above = out_gradient[query, head]
            start = 0
            for level in range(levels):
                height, width = level_shapes[level]
                for point in range(points):
                    locations_gradient[query, head, level, point, :] = 0
                    weights_gradient[query, head, level, point] = 0
                    x = locations[query, head, level, point, 0] * np.float32(width) - half
                    y = locations[query, head, level, point, 1] * np.float32(height) - half
                    if not (x > -1 and x < width and y > -1 and y < height):
                        continue
                    left, top = np.int64(np.floor(x)), np.int64(np.floor(y))
                    right_share, bottom_share = x - np.float32(left), y - np.float32(top)
                    left_share, top_share = one - right_share, one - bottom_share
                    first = start + top * width + left
                    at_left, at_right, at_top, at_bottom = left >= 0, left + 1 < width, top >= 0, top + 1 < height
                    # Outside the map zeros are read, and what is written is not used.
                    a = tokens[first, head] if at_top and at_left else nothing
                    b = tokens[first + 1, head] if at_top and at_right else nothing
                    c = tokens[first + width, head] if at_bottom and at_left else nothing
                    d = tokens[first + width + 1, head] if at_bottom and at_right else nothing
                    to_a = tokens_gradient[first, head] if at_top and at_left else unused
                    to_b = tokens_gradient[first + 1, head] if at_top and at_right else unused
                    to_c = tokens_gradient[first + width, head] if at_bottom and at_left else unused
                    to_d = tokens_gradient[first + width + 1, head] if at_bottom and at_right else unused
                    weight = weights[query, head, level, point]
                    share_a, share_b = top_share * left_share, top_share * right_share
                    share_c, share_d = bottom_share * left_share, bottom_share * right_share
                    sum_a = sum_b = sum_c = sum_d = np.float32(0)
                    for channel in range(depth):
                        arriving = above[channel]
                        sum_a += arriving * a[channel]
                        sum_b += arriving * b[channel]
                        sum_c += arriving * c[channel]
                        sum_d += arriving * d[channel]
                    for channel in range(depth):
                        arriving = weight * above[channel]
                        to_a[channel] += arriving * share_a
                        to_b[channel] += arriving * share_b
                        to_c[channel] += arriving * share_c
                        to_d[channel] += arriving * share_d
                    weights_gradient[query, head, level, point] = (
                        share_a * sum_a + share_b * sum_b + share_c * sum_c + share_d * sum_d
                    )
                    along_x = top_share * (sum_b - sum_a) + bottom_share * (sum_d - sum_c)
                    along_y = left_share * (sum_c - sum_a) + right_share * (sum_d - sum_b)
                    locations_gradient[query, head, level, point, 0] = weight * along_x * np.float32(width)
                    locations_gradient[query, head, level, point, 1] = weight * along_y * np.float32(height)
                start += height * width
