"""The stem of a ResNet on a GPU: after its convolution, pooling, bias and ReLU in one pass by a Triton kernel.

Import it only where Triton is installed.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
import triton
import triton.language as tl
from torch import Tensor

from bevcli.model.resnet import ResNet

ELEMENTS_PER_PROGRAM = 1024


class FusedStem(ResNet):
    """A `ResNet` whose batch norms are folded into their convolutions. No gradients."""

    def stem(self, images: Tensor) -> Tensor:
        """As `ResNet.stem`."""
        convolution = self.conv1
        x = F.conv2d(images, convolution.weight, None, convolution.stride, convolution.padding)
        x = x.contiguous(memory_format=torch.channels_last)
        height, width = ((length + 1) // 2 for length in x.shape[2:])
        out = x.new_empty(len(x), height, width, x.shape[1]).permute(0, 3, 1, 2)
        if len(x):
            elements = out[0].numel()
            # Triton launches on the current GPU, which need not be that of the tensors.
            with torch.cuda.device(x.device):
                _pool[(triton.cdiv(elements, ELEMENTS_PER_PROGRAM), len(x))](
                    x,
                    convolution.bias,
                    out,
                    elements,
                    *x.shape[2:],
                    height,
                    width,
                    CHANNELS=x.shape[1],
                    BLOCK=ELEMENTS_PER_PROGRAM,
                )
        return out


@triton.jit
def _pool(  # type: ignore[no-untyped-def]
    values, bias, out, elements, height, width, out_height, out_width, CHANNELS: tl.constexpr, BLOCK: tl.constexpr
):
    """ReLU of bias plus the maximum over 3x3 cells, with stride 2 and padding 1; NaN stays NaN.

    One program takes BLOCK elements of one image. values (B, H, W, C), bias (C,), out (B, H', W', C).
    """
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    image = tl.program_id(1).to(tl.int64)
    exists = place < elements
    channel = place % CHANNELS
    column = place // CHANNELS % out_width
    row = place // CHANNELS // out_width
    source = values + image * height * width * CHANNELS
    largest = tl.full((BLOCK,), float("-inf"), tl.float32)
    for tap in tl.static_range(9):
        y = 2 * row + tap // 3 - 1
        x = 2 * column + tap % 3 - 1
        inside = exists & (y >= 0) & (y < height) & (x >= 0) & (x < width)
        value = tl.load(source + (y * width + x) * CHANNELS + channel, inside, float("-inf")).to(tl.float32)
        largest = tl.maximum(largest, value, propagate_nan=tl.PropagateNan.ALL)
    largest += tl.load(bias + channel, exists, 0.0).to(tl.float32)
    tl.store(out + image * elements + place, tl.where(largest < 0, 0.0, largest), exists)
