"""Modulated deformable convolution equals a plain convolution and its definition as loops; the faster ones equal it."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import nn

import bevcli.model.kernels.compiled as compiled
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution, modulated_deformable_convolution
from bevcli.model.kernels.compiled import CompiledDeformableConvolution
from bevcli.workshop.training.kernels import choose_training_kernels


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


def plain_layer(stride: int) -> ModulatedDeformableConvolution:
    random = torch.Generator().manual_seed(stride)
    layer = ModulatedDeformableConvolution(6, 5, stride)
    layer.bias = nn.Parameter(torch.empty(5))
    for parameter in layer.requires_grad_(False).parameters():
        parameter.copy_(0.5 * torch.randn(parameter.shape, generator=random))
    return layer


def image() -> torch.Tensor:
    return torch.randn(2, 6, 15, 11, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("tile_bytes", [1, 20_000, 8 << 20])
def test_compiled_equals_plain(monkeypatch, stride, tile_bytes):
    plain, x = plain_layer(stride), image()
    monkeypatch.setattr(compiled, "TILE_BYTES", tile_bytes)
    fast = CompiledDeformableConvolution(plain)
    torch.testing.assert_close(fast(x), plain(x), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(fast(x.to(memory_format=torch.channels_last)), plain(x), atol=1e-4, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_stays_near(dtype):
    plain, x = plain_layer(1), image()
    expected = plain(x.to(dtype).float())
    found = CompiledDeformableConvolution(plain).to(dtype)(x.to(dtype))
    assert found.dtype == dtype
    assert (found.float() - expected).norm() < 0.03 * expected.norm()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU")
@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_results_and_gradients_on_a_gpu_equal_the_cpu(stride, dtype):
    found = []
    for device in (torch.device("cpu"), torch.device("cuda")):
        layer = plain_layer(stride).to(dtype).to(device, torch.float32 if device.type == "cpu" else dtype)
        x = image().to(dtype).to(layer.weight)
        layer.weight.requires_grad = True
        choose_training_kernels(layers := nn.Sequential(layer), device)
        result = layers(x.requires_grad_())
        gradients = torch.autograd.grad(result.square().sum(), (x, layer.weight))
        found.append([each.float().cpu() for each in (result, *gradients)])
    for expected, equal in zip(*found, strict=True):
        # PyTorch rounds the products of the convolution that predicts offsets to TF32.
        assert (equal - expected).norm() < (0.01 if dtype == torch.float32 else 0.05) * expected.norm()
