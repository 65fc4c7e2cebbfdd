"""Modulated deformable convolution, DCNv2 (Zhu et al. 2019), with one deformable group."""

from __future__ import annotations

from functools import partial
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.model.kernels.compiled_convolution import convolve_compiled

Backend = Literal["grid_sample", "compiled"]
"""grid_sample: tap after tap, with gradients. compiled: on the CPU, tile after tile, without."""


class ModulatedDeformableConvolution(nn.Module):
    """A 3x3 convolution whose nine taps move by learned offsets and are weighted by a learned mask.

    It has no bias but the one that a batch norm folded into it leaves. `backend` says how it is computed; a model
    starts with the one that has gradients.
    """

    backend: Backend = "grid_sample"

    def __init__(self, in_channels: int, out_channels: int, stride: int = 1) -> None:
        super().__init__()
        self.stride = stride
        self.weight = nn.Parameter(torch.empty(out_channels, in_channels, 3, 3))
        self.bias: nn.Parameter | None = None
        self.product: nn.Module | None = None  # of rows of taps, where one is made ready for inference
        self.offset_and_mask = nn.Conv2d(in_channels, 27, 3, stride, padding=1)
        nn.init.kaiming_normal_(self.weight, mode="fan_out", nonlinearity="relu")
        nn.init.zeros_(self.offset_and_mask.weight)
        nn.init.zeros_(self.offset_and_mask.bias)  # type: ignore[arg-type]

    def taps_matrix(self) -> Tensor:
        """The weight for rows of nine taps, one after another: (O, 9 · C)."""
        return self.weight.permute(0, 2, 3, 1).flatten(1).contiguous()

    def forward(self, x: Tensor) -> Tensor:
        """x: (B, C, H, W) -> (B, out_channels, H', W')."""
        moves = self.offset_and_mask(x).float()
        # Channels 0 to 17 are nine (dy, dx) pairs, one a tap; 18 to 26 the mask.
        offsets = moves[:, :18].unflatten(1, (9, 2))  # (B, 9, 2, H', W')
        mask = moves[:, 18:].sigmoid()  # (B, 9, H', W')
        if self.backend == "compiled":
            product = self.product or partial(F.linear, weight=self.taps_matrix(), bias=self.bias)
            return convolve_compiled(x, offsets, mask, product, len(self.weight), self.stride)
        y = modulated_deformable_convolution(x, offsets, mask, self.weight, self.stride)
        return y if self.bias is None else y + self.bias[:, None, None]


def modulated_deformable_convolution(
    x: Tensor, offsets: Tensor, mask: Tensor, weight: Tensor, stride: int = 1
) -> Tensor:
    """A 3x3 convolution with padding 1 whose taps are moved and weighted at every position.

    x: (B, C, H, W). offsets: (B, 9, 2, H', W') float32, (dy, dx) in cells, taps row by row. mask: (B, 9, H', W').
    weight: (O, C, 3, 3). Returns (B, O, H', W'). Sampling is bilinear, with zeros outside x.
    """
    taps = weight.flatten(2).unbind(-1)
    tap_y, tap_x = _tap_positions(offsets.shape[-2:], stride, x.device)  # (9, H', 1), (9, 1, W')
    result = x.new_zeros(())
    # Tap after tap: no copy larger than one sampled map exists at a time.
    for k, tap in enumerate(taps):
        y = tap_y[k] + offsets[:, k, 0]
        sampled = _sample(x, y, tap_x[k] + offsets[:, k, 1]) * mask[:, k, None].to(x.dtype)
        result = result + F.conv2d(sampled, tap[..., None, None])
    return result


def _tap_positions(size: torch.Size, stride: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Where the nine taps of each output position lie without offsets: y (9, H', 1) and x (9, 1, W') in cells."""
    step = torch.arange(-1, 2, device=device, dtype=torch.float32)
    rows = torch.arange(size[0], device=device, dtype=torch.float32) * stride
    columns = torch.arange(size[1], device=device, dtype=torch.float32) * stride
    tap_y = step.repeat_interleave(3)[:, None, None] + rows[:, None]
    tap_x = step.repeat(3)[:, None, None] + columns
    return tap_y, tap_x


def _sample(x: Tensor, y_cells: Tensor, x_cells: Tensor) -> Tensor:
    """x: (B, C, H, W) at y, x (B, H', W') in cells -> (B, C, H', W')."""
    height, width = x.shape[-2:]
    grid = torch.stack([(2 * x_cells + 1) / width - 1, (2 * y_cells + 1) / height - 1], dim=-1)
    return F.grid_sample(x.float(), grid, align_corners=False).to(x.dtype)
