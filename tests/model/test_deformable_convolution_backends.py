"""The compiled deformable convolution equals the plain one, tile by tile."""

from __future__ import annotations

import pytest
import torch

import bevcli.model.kernels.compiled as compiled
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution
from bevcli.model.kernels.choose import BiasedDeformableConvolution
from bevcli.model.kernels.compiled import CompiledDeformableConvolution


def plain_layer(stride: int) -> BiasedDeformableConvolution:
    random = torch.Generator().manual_seed(stride)
    layer = ModulatedDeformableConvolution(6, 5, stride).requires_grad_(False)
    for parameter in layer.parameters():
        parameter.copy_(0.5 * torch.randn(parameter.shape, generator=random))
    return BiasedDeformableConvolution(layer, torch.randn(5, generator=random))


def image() -> torch.Tensor:
    return torch.randn(2, 6, 15, 11, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("tile_bytes", [1, 20_000, 8 << 20])
def test_compiled_equals_plain(monkeypatch, stride, tile_bytes):
    plain, x = plain_layer(stride), image()
    monkeypatch.setattr(compiled, "TILE_BYTES", tile_bytes)
    fast = CompiledDeformableConvolution(plain.convolution, plain.bias)
    torch.testing.assert_close(fast(x), plain(x), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(fast(x.to(memory_format=torch.channels_last)), plain(x), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_stays_near(dtype):
    plain, x = plain_layer(1), image()
    expected = plain(x.to(dtype).float())
    found = CompiledDeformableConvolution(plain.convolution, plain.bias).to(dtype)(x.to(dtype))
    assert found.dtype == dtype
    assert (found.float() - expected).norm() < 0.03 * expected.norm()
