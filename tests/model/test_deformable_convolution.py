"""Modulated deformable convolution compared with a plain convolution and with its definition as loops."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from bevcli.model.deformable_convolution import ModulatedDeformableConvolution, modulated_deformable_convolution


@pytest.mark.parametrize("stride", [1, 2])
def test_without_offsets_and_with_full_mask_it_is_plain(stride: int) -> None:
    torch.manual_seed(0)
    x, weight = torch.randn(2, 4, 7, 9), torch.randn(5, 4, 3, 3)
    plain = F.conv2d(x, weight, stride=stride, padding=1)
    height, width = plain.shape[-2:]
    offsets, mask = torch.zeros(2, 9, 2, height, width), torch.ones(2, 9, height, width)
    ours = modulated_deformable_convolution(x, offsets, mask, weight, stride)
    torch.testing.assert_close(ours, plain, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("stride", [1, 2])
def test_it_equals_its_definition_as_loops(stride: int) -> None:
    random = np.random.default_rng(1)
    x, weight = random.normal(size=(3, 6, 7)), random.normal(size=(2, 3, 3, 3))
    out_height, out_width = (6 - 1) // stride + 1, (7 - 1) // stride + 1
    offsets = 2.5 * random.normal(size=(9, 2, out_height, out_width))
    mask = random.random((9, out_height, out_width))
    expected = _by_loops(x, offsets, mask, weight, stride)
    ours = modulated_deformable_convolution(
        *(torch.from_numpy(array).float()[None] for array in (x, offsets, mask)),
        torch.from_numpy(weight).float(),
        stride,
    )
    np.testing.assert_allclose(ours[0].numpy(), expected, atol=1e-4)


def test_the_predicted_channels_are_pairs_of_dy_dx_then_the_mask() -> None:
    layer = ModulatedDeformableConvolution(1, 1)
    with torch.no_grad():
        layer.weight.zero_()
        layer.weight[0, 0, 1, 1] = 1  # only the middle tap, the fifth
        layer.offset_and_mask.bias[2 * 4] = 2  # dy of the fifth tap
        layer.offset_and_mask.bias[2 * 4 + 1] = -1  # dx of the fifth tap
        layer.offset_and_mask.bias[18 + 4] = 100  # its mask, 1 after the sigmoid
        x = torch.randn(1, 1, 6, 6)
        torch.testing.assert_close(layer(x)[0, 0, :4, 1:], x[0, 0, 2:, :5], atol=1e-4, rtol=1e-4)


def test_an_untrained_layer_is_half_a_plain_convolution() -> None:
    torch.manual_seed(2)
    layer, x = ModulatedDeformableConvolution(4, 6, stride=2), torch.randn(1, 4, 8, 8)
    expected = 0.5 * F.conv2d(x, layer.weight, stride=2, padding=1)
    torch.testing.assert_close(layer(x), expected, atol=1e-5, rtol=1e-5)


def _by_loops(x: np.ndarray, offsets: np.ndarray, mask: np.ndarray, weight: np.ndarray, stride: int) -> np.ndarray:
    out = np.zeros((len(weight), *mask.shape[1:]))
    for row, column in np.ndindex(*mask.shape[1:]):
        for tap in range(9):
            y = row * stride + tap // 3 - 1 + offsets[tap, 0, row, column]
            x_ = column * stride + tap % 3 - 1 + offsets[tap, 1, row, column]
            value = mask[tap, row, column] * _bilinear(x, y, x_)
            out[:, row, column] += weight[:, :, tap // 3, tap % 3] @ value
    return out


def _bilinear(x: np.ndarray, y: float, x_: float) -> np.ndarray:
    """x: (C, H, W) at a location in cells, zero outside."""
    value = np.zeros(len(x))
    top, left = int(np.floor(y)), int(np.floor(x_))
    for i, j in ((top, left), (top, left + 1), (top + 1, left), (top + 1, left + 1)):
        if 0 <= i < x.shape[1] and 0 <= j < x.shape[2]:
            value += x[:, i, j] * (1 - abs(y - i)) * (1 - abs(x_ - j))
    return value
