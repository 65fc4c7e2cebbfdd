"""Parts of a backbone on a GPU in Triton: modulated deformable convolution, and the stem of a ResNet.

Import it only where Triton is installed. Positions, offsets, masks and sums are float32; the values and the weight keep
the data type of the images. Everything is laid out channels last, so that a sample reads successive channels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
import triton
import triton.language as tl
from torch import Tensor

from bevcli.model.deformable_convolution import ModulatedDeformableConvolution
from bevcli.model.kernels.triton_attention import corner_of
from bevcli.model.resnet import ResNet

# Positions, channels and taps that a program takes at a time.
COLUMN_TILES = {"BLOCK": 8, "BLOCK_CHANNELS": 128, "TAPS": 9}
GRADIENT_TILES = {"BLOCK": 16, "BLOCK_CHANNELS": 64, "TAPS": 1}
COLUMN_BYTES = 512 << 20  # of the columns that exist at a time


class TritonDeformableConvolution(ModulatedDeformableConvolution):
    """A `ModulatedDeformableConvolution` on a GPU."""

    def forward(self, x: Tensor) -> Tensor:
        """As `ModulatedDeformableConvolution.forward`; the result is channels last."""
        return deformable_convolution(x, self.offset_and_mask(x), self.weight, self.bias, self.stride)


def deformable_convolution(x: Tensor, predicted: Tensor, weight: Tensor, bias: Tensor | None, stride: int) -> Tensor:
    """Takes the place of `predicted_deformable_convolution` on a GPU, with gradients.

    Arguments and result as there; the result is channels last.
    """
    bias = weight.new_zeros(len(weight)) if bias is None else bias
    return _Convolution.apply(x, predicted, weight.to(x.dtype), bias.to(x.dtype), stride)


class _Convolution(torch.autograd.Function):
    @staticmethod
    def forward(context: Any, x: Tensor, predicted: Tensor, weight: Tensor, bias: Tensor, stride: int) -> Tensor:
        x, predicted = _channels_last(x), _channels_last(predicted)
        context.save_for_backward(x, predicted, weight)
        context.stride = stride
        shape = (len(x), *predicted.shape[2:], len(weight))
        out = x.new_empty(shape)
        # Triton launches on the current GPU, which need not be that of the tensors.
        with torch.cuda.device(x.device):
            for part in _parts(x, predicted):
                columns = _columns(x[part], predicted[part], stride)
                torch.addmm(bias, columns, _rows(weight).T, out=out[part].flatten(0, 2))
        return out.permute(0, 3, 1, 2)  # (B, O, H', W')

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        x, predicted, weight = context.saved_tensors
        gradient = _channels_last(gradients[0]).permute(0, 2, 3, 1)  # (B, H', W', O)
        rows = _rows(weight)
        x_gradient = torch.zeros_like(x, dtype=torch.float32)
        predicted_gradient = torch.zeros_like(predicted, dtype=torch.float32)
        weight_gradient = rows.new_zeros(rows.shape, dtype=torch.float32)
        with torch.cuda.device(x.device):
            for part in _parts(x, predicted):
                of_part = gradient[part].flatten(0, 2)  # (positions, O)
                weight_gradient += of_part.T @ _columns(x[part], predicted[part], context.stride)
                tensors = (x[part], predicted[part], of_part @ rows, x_gradient[part], predicted_gradient[part])
                _launch(_add_gradients, tensors, context.stride, GRADIENT_TILES)
        weight_gradient = weight_gradient.view(len(weight), 3, 3, -1).permute(0, 3, 1, 2)
        bias_gradient = gradient.sum((0, 1, 2), dtype=torch.float32)
        learned = (x_gradient, predicted_gradient, weight_gradient, bias_gradient)
        dtypes = (x.dtype, predicted.dtype, weight.dtype, weight.dtype)
        return *(gradient.to(dtype) for gradient, dtype in zip(learned, dtypes, strict=True)), None


def _channels_last(x: Tensor) -> Tensor:
    return x.contiguous(memory_format=torch.channels_last)


def _rows(weight: Tensor) -> Tensor:
    """(O, C, 3, 3) -> (O, 9 · C), without a copy where it is channels last."""
    return weight.permute(0, 2, 3, 1).flatten(1)


def _parts(x: Tensor, predicted: Tensor) -> Iterator[slice]:
    """Ranges of images whose columns take at most `COLUMN_BYTES`."""
    bytes_per_image = 9 * x.shape[1] * predicted[0, 0].numel() * x.element_size() if len(x) else 1
    step = max(COLUMN_BYTES // max(bytes_per_image, 1), 1)
    return (slice(first, first + step) for first in range(0, len(x), step))


def _columns(x: Tensor, predicted: Tensor, stride: int) -> Tensor:
    """The samples of all taps times their masks: (positions, 9 · C)."""
    columns = x.new_empty(predicted[:, 0].numel(), 9 * x.shape[1])
    _launch(_write_columns, (x, predicted, columns), stride, COLUMN_TILES)
    return columns


def _launch(kernel: Any, tensors: Sequence[Tensor], stride: int, tiles: Mapping[str, int]) -> None:
    """Starts a program for each block of positions and each group of taps.

    tensors: x, what is predicted, and the others that the kernel takes. tiles: as for `constants`.
    """
    x, predicted = tensors[:2]
    positions = predicted[:, 0].numel()
    if positions:
        settings = constants(x.shape[1], stride, tiles)
        grid = (triton.cdiv(positions, settings["BLOCK"]) * 9 // settings["TAPS"],)
        kernel[grid](*tensors, positions, *x.shape[2:], *predicted.shape[2:], **settings)


def constants(channels: int, stride: int, tiles: Mapping[str, int]) -> dict[str, int]:
    """The arguments that a kernel is compiled for: `COLUMN_TILES` or `GRADIENT_TILES`."""
    block = min(max(triton.next_power_of_2(channels), 16), tiles["BLOCK_CHANNELS"])
    return {"CHANNELS": channels, "STRIDE": stride, **tiles, "BLOCK_CHANNELS": block}


@triton.jit
def _tap(  # type: ignore[no-untyped-def]
    predicted, position, exists, tap, height, width, out_height, out_width, STRIDE: tl.constexpr
):
    """First cell of the image, y and x in cells, and the mask of one tap at output positions."""
    column = position % out_width
    row = position // out_width
    image = (row // out_height).to(tl.int64)
    address = predicted + position.to(tl.int64) * 27
    y = (row % out_height * STRIDE + tap // 3 - 1).to(tl.float32)
    x = (column * STRIDE + tap % 3 - 1).to(tl.float32)
    y += tl.load(address + 2 * tap, exists, 0.0).to(tl.float32)
    x += tl.load(address + 2 * tap + 1, exists, 0.0).to(tl.float32)
    # Positions more than a cell outside contribute nothing; the clamp keeps them within an int32.
    y = tl.minimum(tl.maximum(y, -2.0), height + 1.0)
    x = tl.minimum(tl.maximum(x, -2.0), width + 1.0)
    mask = tl.sigmoid(tl.load(address + 18 + tap, exists, 0.0).to(tl.float32))
    return image * height * width, y, x, mask


@triton.jit
def _sampled(  # type: ignore[no-untyped-def]
    values, first_cell, y, x, mask, exists, channel, height, width, CHANNELS: tl.constexpr, BLOCK_CHANNELS: tl.constexpr
):
    """(positions, channels) float32: the samples times the mask."""
    total = tl.zeros((y.shape[0], BLOCK_CHANNELS), tl.float32)
    for corner in tl.static_range(4):
        cell, of_rows, of_columns, inside = corner_of(first_cell, y, x, exists, height, width, corner)
        address = values + cell[:, None] * CHANNELS + channel[None, :]
        if CHANNELS % BLOCK_CHANNELS == 0:
            value = tl.load(address, inside[:, None], 0.0)
        else:
            value = tl.load(address, inside[:, None] & (channel < CHANNELS)[None, :], 0.0)
        total += (of_rows * of_columns * mask)[:, None] * value.to(tl.float32)
    return total


@triton.jit
def _write_columns(  # type: ignore[no-untyped-def]
    values,
    predicted,
    columns,
    positions,
    height,
    width,
    out_height,
    out_width,
    CHANNELS: tl.constexpr,
    STRIDE: tl.constexpr,
    BLOCK: tl.constexpr,
    BLOCK_CHANNELS: tl.constexpr,
    TAPS: tl.constexpr,
):
    """One program writes the samples of TAPS taps at BLOCK positions to columns (positions, 9, C)."""
    groups: tl.constexpr = 9 // TAPS
    position = tl.program_id(0) // groups * BLOCK + tl.arange(0, BLOCK)
    exists = position < positions
    for index in range(TAPS):
        tap = tl.program_id(0) % groups * TAPS + index
        first_cell, y, x, mask = _tap(predicted, position, exists, tap, height, width, out_height, out_width, STRIDE)
        target = columns + (position.to(tl.int64) * 9 + tap)[:, None] * CHANNELS
        for first in range(0, CHANNELS, BLOCK_CHANNELS):
            channel = first + tl.arange(0, BLOCK_CHANNELS)
            sampled = _sampled(values, first_cell, y, x, mask, exists, channel, height, width, CHANNELS, BLOCK_CHANNELS)
            written = exists[:, None] & (channel < CHANNELS)[None, :]
            tl.store(target + channel[None, :], sampled.to(columns.dtype.element_ty), written)


@triton.jit
def _add_gradients(  # type: ignore[no-untyped-def]
    values,
    predicted,
    columns_gradient,
    values_gradient,
    predicted_gradient,
    positions,
    height,
    width,
    out_height,
    out_width,
    CHANNELS: tl.constexpr,
    STRIDE: tl.constexpr,
    BLOCK: tl.constexpr,
    BLOCK_CHANNELS: tl.constexpr,
    TAPS: tl.constexpr,
):
    """One program takes TAPS taps at BLOCK positions: adds to values_gradient, writes predicted_gradient, both float32.

    columns_gradient: (positions, 9, C). The gradients are laid out as what they are the gradients of.
    """
    groups: tl.constexpr = 9 // TAPS
    position = tl.program_id(0) // groups * BLOCK + tl.arange(0, BLOCK)
    exists = position < positions
    for index in range(TAPS):
        tap = tl.program_id(0) % groups * TAPS + index
        first_cell, y, x, mask = _tap(predicted, position, exists, tap, height, width, out_height, out_width, STRIDE)
        of_y = tl.zeros((BLOCK,), tl.float32)
        of_x = tl.zeros((BLOCK,), tl.float32)
        of_mask = tl.zeros((BLOCK,), tl.float32)
        source = columns_gradient + (position.to(tl.int64) * 9 + tap)[:, None] * CHANNELS
        for first in range(0, CHANNELS, BLOCK_CHANNELS):
            channel = first + tl.arange(0, BLOCK_CHANNELS)
            has_channel = channel < CHANNELS
            gradient = tl.load(source + channel[None, :], exists[:, None] & has_channel[None, :], 0.0).to(tl.float32)
            for corner in tl.static_range(4):
                cell, of_rows, of_columns, inside = corner_of(first_cell, y, x, exists, height, width, corner)
                element = cell[:, None] * CHANNELS + channel[None, :]
                read = inside[:, None] & has_channel[None, :]
                value = tl.load(values + element, read, 0.0).to(tl.float32)
                tl.atomic_add(
                    values_gradient + element, (of_rows * of_columns * mask)[:, None] * gradient, read, "relaxed"
                )
                product = tl.sum(value * gradient, 1)
                of_mask += of_rows * of_columns * product
                of_y += (corner // 2 * 2 - 1) * of_columns * product
                of_x += (corner % 2 * 2 - 1) * of_rows * product
        address = predicted_gradient + position.to(tl.int64) * 27
        tl.store(address + 2 * tap, of_y * mask, exists)
        tl.store(address + 2 * tap + 1, of_x * mask, exists)
        tl.store(address + 18 + tap, of_mask * mask * (1.0 - mask), exists)


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
    element = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    image = tl.program_id(1).to(tl.int64)
    exists = element < elements
    channel = element % CHANNELS
    column = element // CHANNELS % out_width
    row = element // CHANNELS // out_width
    source = values + image * height * width * CHANNELS
    largest = tl.full((BLOCK,), float("-inf"), tl.float32)
    for tap in tl.static_range(9):
        y = 2 * row + tap // 3 - 1
        x = 2 * column + tap % 3 - 1
        inside = exists & (y >= 0) & (y < height) & (x >= 0) & (x < width)
        value = tl.load(source + (y * width + x) * CHANNELS + channel, inside, float("-inf")).to(tl.float32)
        largest = tl.maximum(largest, value, propagate_nan=tl.PropagateNan.ALL)
    largest += tl.load(bias + channel, exists, 0.0).to(tl.float32)
    tl.store(out + image * elements + element, tl.where(largest < 0, 0.0, largest), exists)
