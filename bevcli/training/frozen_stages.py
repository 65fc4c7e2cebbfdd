"""The first stages of a backbone whose weights a training keeps, computed as in inference: faster, the same results."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Iterator

import torch
from torch import Tensor, nn

from bevcli.model.kernels.onednn import use_onednn
from bevcli.model.prepared import fold_batch_norms
from bevcli.model.resnet import ResNet


class FrozenStages:
    """A copy of the stem and the first stages of a backbone, with batch norms in evaluation mode.

    Batch norms are folded into their convolutions and, on a CPU, oneDNN runs the residual blocks, one image at a time,
    whose feature maps fit into the caches.
    """

    def __init__(self, backbone: ResNet, stages: int, dtype: torch.dtype) -> None:
        """stages: how many, from the first. dtype: of the computation and its results."""
        self._device = backbone.conv1.weight.device
        self._dtype = dtype
        part = copy.deepcopy(backbone)
        part.stages = nn.ModuleList(part.stages[:stages])
        part.output_stages = tuple(range(1, len(part.stages) + 1))
        part.eval().requires_grad_(False)
        fold_batch_norms(part, self._device)
        part.to(dtype, memory_format=torch.channels_last)  # type: ignore[call-overload]
        if self._device.type == "cpu":
            use_onednn(part)
        self._part = part

    @contextlib.contextmanager
    def used_by(self, backbone: ResNet) -> Iterator[None]:
        """Inside, the backbone takes the maps of its first stages from here."""
        backbone.frozen_maps = self._maps
        try:
            yield
        finally:
            backbone.frozen_maps = None

    @torch.no_grad()
    def _maps(self, images: Tensor) -> list[Tensor]:
        """images: (B, 3, H, W) -> the map of each stage, without gradient."""
        with torch.autocast(self._device.type, enabled=False):
            images = images.to(self._dtype).contiguous(memory_format=torch.channels_last)
            if self._device.type != "cpu":
                return list(self._part(images))
            each = [self._part(image) for image in images.split(1)]
            return [torch.cat(maps) for maps in zip(*each, strict=True)]
