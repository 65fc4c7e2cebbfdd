"""The faster deformable convolutions equal the plain one."""

from __future__ import annotations

import pytest
import torch
from torch import nn

import bevcli.model.kernels.compiled as compiled
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution
from bevcli.model.kernels.choose import choose_kernels
from bevcli.model.kernels.compiled import CompiledDeformableConvolution


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
        choose_kernels(layers := nn.Sequential(layer), device, gradients=True)
        result = layers(x.requires_grad_())
        gradients = torch.autograd.grad(result.square().sum(), (x, layer.weight))
        found.append([each.float().cpu() for each in (result, *gradients)])
    for expected, equal in zip(*found, strict=True):
        # PyTorch rounds the products of the convolution that predicts offsets to TF32.
        assert (equal - expected).norm() < (0.01 if dtype == torch.float32 else 0.05) * expected.norm()
