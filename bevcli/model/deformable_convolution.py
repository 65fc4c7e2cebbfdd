"""Modulated deformable convolution, DCNv2 (Zhu et al. 2019), with one deformable group."""

from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class ModulatedDeformableConvolution(nn.Module):
    """A 3x3 convolution whose nine taps are moved by predicted offsets and weighted by a mask.

    Attributes:
        bias: (O,), None until a batch norm is folded into the convolution.
    """

    folds_batch_norm: ClassVar[bool] = True
    bias: nn.Parameter | None

    def __init__(self, in_channels: int, out_channels: int, stride: int = 1) -> None:
        super().__init__()
        self.stride = stride
        self.weight = nn.Parameter(torch.empty(out_channels, in_channels, 3, 3))
        self.register_parameter("bias", None)
        self.offset_and_mask = nn.Conv2d(in_channels, 27, 3, stride, padding=1)
        nn.init.kaiming_normal_(self.weight, mode="fan_out", nonlinearity="relu")
        nn.init.zeros_(self.offset_and_mask.weight)
        nn.init.zeros_(self.offset_and_mask.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        """x: (B, C, H, W) -> (B, out_channels, H', W')."""
        return predicted_deformable_convolution(x, self.offset_and_mask(x), self.weight, self.bias, self.stride)


def predicted_deformable_convolution(
    x: Tensor, predicted: Tensor, weight: Tensor, bias: Tensor | None, stride: int
) -> Tensor:
    """`modulated_deformable_convolution` plus bias (O,), for what is predicted; see `split_offsets_and_mask`."""
    result = modulated_deformable_convolution(x, *split_offsets_and_mask(predicted), weight, stride)
    return result if bias is None else result + bias[:, None, None]


def split_offsets_and_mask(predicted: Tensor) -> tuple[Tensor, Tensor]:
    """(B, 27, H', W') -> offsets (B, 9, 2, H', W') and mask (B, 9, H', W'), 0 to 1, both float32.

    Channels 0 to 17 are a pair (dy, dx) for each of the nine taps, channels 18 to 26 the logits of the mask.
    """
    predicted = predicted.float()
    return predicted[:, :18].unflatten(1, (9, 2)), predicted[:, 18:].sigmoid()


def modulated_deformable_convolution(
    x: Tensor, offsets: Tensor, mask: Tensor, weight: Tensor, stride: int = 1
) -> Tensor:
    """A 3x3 convolution with padding 1 whose taps are moved and weighted at every position -> (B, O, H', W').

    Sampling is bilinear, with zeros outside x.

    Args:
        x: (B, C, H, W).
        offsets: (B, 9, 2, H', W') float32, (dy, dx) in cells, taps row by row.
        mask: (B, 9, H', W').
        weight: (O, C, 3, 3).
        stride: of the output positions, in cells of x.
    """
    tap_y, tap_x = _tap_positions(offsets.shape[-2:], stride, x.device)  # (9, H', 1), (9, 1, W')
    result = x.new_zeros(())
    # One tap at a time, so that only one sampled map is held in memory.
    for k, tap in enumerate(weight.flatten(2).unbind(-1)):
        y = tap_y[k] + offsets[:, k, 0]
        sampled = _sample(x, y, tap_x[k] + offsets[:, k, 1]) * mask[:, k, None].to(x.dtype)
        result = result + F.conv2d(sampled, tap[..., None, None])
    return result


def _tap_positions(size: torch.Size, stride: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Positions of the nine taps without offsets, in cells: y (9, H', 1) and x (9, 1, W')."""
    step = torch.arange(-1, 2, device=device, dtype=torch.float32)
    rows = torch.arange(size[0], device=device, dtype=torch.float32) * stride
    columns = torch.arange(size[1], device=device, dtype=torch.float32) * stride
    tap_y = step.repeat_interleave(3)[:, None, None] + rows[:, None]
    tap_x = step.repeat(3)[:, None, None] + columns
    return tap_y, tap_x


def _sample(x: Tensor, y_cells: Tensor, x_cells: Tensor) -> Tensor:
    """x: (B, C, H, W), sampled at y, x (B, H', W') in cells -> (B, C, H', W')."""
    height, width = x.shape[-2:]
    grid = torch.stack([(2 * x_cells + 1) / width - 1, (2 * y_cells + 1) / height - 1], dim=-1)
    return F.grid_sample(x.float(), grid, align_corners=False).to(x.dtype)
