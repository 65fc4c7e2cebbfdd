"""The compiled deformable convolution answers as the plain one, tile by tile."""

from __future__ import annotations

import pytest
import torch

import bevcli.model.kernels.compiled_convolution as compiled
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution


def layer_and_image(stride: int) -> tuple[ModulatedDeformableConvolution, torch.Tensor]:
    random = torch.Generator().manual_seed(stride)
    layer = ModulatedDeformableConvolution(6, 5, stride).requires_grad_(False)
    for parameter in layer.parameters():
        parameter.copy_(0.5 * torch.randn(parameter.shape, generator=random))
    layer.bias = torch.nn.Parameter(torch.randn(5, generator=random), requires_grad=False)
    return layer, torch.randn(2, 6, 15, 11, generator=random)


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("tile_bytes", [1, 20_000, 8 << 20])
def test_compiled_equals_plain(monkeypatch, stride, tile_bytes):
    layer, x = layer_and_image(stride)
    expected = layer(x)
    monkeypatch.setattr(compiled, "TILE_BYTES", tile_bytes)
    layer.backend = "compiled"
    torch.testing.assert_close(layer(x), expected, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(layer(x.to(memory_format=torch.channels_last)), expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_rounds_what_it_sampled_in_float32(dtype):
    layer, x = layer_and_image(1)
    expected = layer(x.to(dtype).float())
    layer.backend = "compiled"
    layer.to(dtype)
    found = layer(x.to(dtype))
    assert found.dtype == dtype
    assert (found.float() - expected).norm() < 0.03 * expected.norm()
