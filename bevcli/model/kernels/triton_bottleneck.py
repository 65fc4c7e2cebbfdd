"""Bottlenecks on a GPU: after each convolution, bias, shortcut and ReLU in one pass by a Triton kernel.

Import it only where Triton is installed.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
import triton
import triton.language as tl
from torch import Tensor, nn

from bevcli.model.resnet import Bottleneck

ELEMENTS_PER_PROGRAM = 1024
MOST_ELEMENTS = 2**31 - ELEMENTS_PER_PROGRAM  # the kernel counts in int32


class FusedBottleneck(Bottleneck):
    """Added to the bottlenecks whose batch norms are folded into their convolutions. No gradients."""

    def forward(self, x: Tensor) -> Tensor:
        """As `Bottleneck.forward`."""
        y = convolution_with_relu(self.conv1, x)
        y = convolution_with_relu(self.conv2, y)
        return convolution_with_relu(self.conv3, y, self.downsample(x))


def convolution_with_relu(convolution: nn.Module, x: Tensor, shortcut: Tensor | None = None) -> Tensor:
    """ReLU of the convolution of x plus the shortcut, which has the shape of the result."""
    if not isinstance(convolution, nn.Conv2d) or convolution.bias is None:
        return F.relu(convolution(x) if shortcut is None else convolution(x) + shortcut)
    y = convolution._conv_forward(x, convolution.weight, None)
    parts = [y] if shortcut is None else [y, shortcut]
    if y.numel() > MOST_ELEMENTS or not all(part.is_contiguous(memory_format=torch.channels_last) for part in parts):
        y = y + convolution.bias[:, None, None]
        return F.relu(y if shortcut is None else y + shortcut)
    # Triton launches on the current GPU, which need not be that of the tensors.
    with torch.cuda.device(y.device):
        _add_and_relu[(triton.cdiv(y.numel(), ELEMENTS_PER_PROGRAM),)](
            y,
            convolution.bias,
            parts[-1],
            y.numel(),
            y.shape[1],
            HAS_SHORTCUT=shortcut is not None,
            BLOCK=ELEMENTS_PER_PROGRAM,
        )
    return y


@triton.jit
def _add_and_relu(  # type: ignore[no-untyped-def]
    values, bias, shortcut, elements, channels, HAS_SHORTCUT: tl.constexpr, BLOCK: tl.constexpr
):
    """In place, values become ReLU(values + bias + shortcut); NaN stays NaN. values: channels last."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    exists = place < elements
    value = tl.load(values + place, exists).to(tl.float32) + tl.load(bias + place % channels, exists).to(tl.float32)
    if HAS_SHORTCUT:
        value += tl.load(shortcut + place, exists).to(tl.float32)
    tl.store(values + place, tl.where(value < 0, 0.0, value), exists)
