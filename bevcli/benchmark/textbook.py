"""The plain version: the yardstick for the speed of the prepared model, and the reference for its results."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from bevcli.model.bevformer import BEVFormerBase
from bevcli.model.deformable_attention import DeformableAttention, LevelShapes, sample_maps


def textbook_version(model: BEVFormerBase, device: torch.device) -> BEVFormerBase:
    """A copy of the plain model on a device that samples as the released code does.

    Separate batch norms, channels-first float32, `grid_sample` with the queries of every camera padded to the longest
    list.
    """
    textbook = copy.deepcopy(model).to(device).eval().requires_grad_(False)
    for module in textbook.modules():
        if isinstance(module, DeformableAttention):
            module.sampling = PaddedSampling()
    return textbook


class PaddedSampling(nn.Module):
    """`grid_sample` of all maps at once; the queries of every map are padded to the longest list."""

    def forward(
        self,
        values: Tensor,
        level_shapes: LevelShapes,
        locations: Tensor,
        weights: Tensor,
        queries_per_map: Sequence[int],
    ) -> Tensor:
        """Arguments and result as for `GridSampling`."""
        counts = torch.tensor(queries_per_map, device=values.device)
        longest = max(queries_per_map)
        is_query = torch.arange(longest, device=values.device) < counts[:, None]  # (G, longest)
        padded_locations = locations.new_zeros(len(counts), longest, *locations.shape[1:])
        padded_weights = weights.new_zeros(len(counts), longest, *weights.shape[1:])
        padded_locations[is_query], padded_weights[is_query] = locations, weights
        return sample_maps(values, level_shapes, padded_locations, padded_weights)[is_query]
