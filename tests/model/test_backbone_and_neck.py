"""ResNet and FPN: sizes, strides, and the flow of context from coarse to fine maps."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from bevcli.model.fpn import FPN, FPNConfig
from bevcli.model.resnet import Bottleneck, ResNet, ResNetConfig


@pytest.mark.parametrize("style", ["pytorch", "caffe"])
def test_stages_halve_the_map_and_double_the_channels(style: str) -> None:
    config = ResNetConfig((1, 1, 2, 1), style, (1, 2, 3, 4), deformable_stages=(3, 4), width=4)
    maps = ResNet(config).eval()(torch.randn(2, 3, 64, 96))
    assert [tuple(x.shape) for x in maps] == [(2, 16, 16, 24), (2, 32, 8, 12), (2, 64, 4, 6), (2, 128, 2, 3)]
    assert config.output_channels() == (16, 32, 64, 128)


@pytest.mark.parametrize(("style", "strided"), [("pytorch", "conv2"), ("caffe", "conv1")])
def test_the_style_decides_which_convolution_has_the_stride(style: str, strided: str) -> None:
    block = Bottleneck(16, 8, 2, style, deformable=False)
    strides = {name: getattr(block, name).stride for name in ("conv1", "conv2")}
    assert [name for name, stride in strides.items() if stride == (2, 2)] == [strided]


def test_an_untrained_block_is_the_identity() -> None:
    x = torch.rand(1, 32, 5, 5)
    assert torch.equal(Bottleneck(32, 8, 1, "pytorch", deformable=False).eval()(x), x)


def test_stages_after_the_last_output_stage_are_left_out() -> None:
    config = ResNetConfig((1, 1, 1, 1), output_stages=(2,), width=4)
    assert len(ResNet(config).stages) == 2


def test_each_extra_level_halves_the_one_before() -> None:
    neck = FPN((8, 16), 6, FPNConfig(levels=4))
    maps = neck([torch.randn(1, 8, 10, 14), torch.randn(1, 16, 5, 7)])
    assert [tuple(x.shape) for x in maps] == [(1, 6, 10, 14), (1, 6, 5, 7), (1, 6, 3, 4), (1, 6, 2, 2)]


def test_context_flows_from_coarse_to_fine_only() -> None:
    neck = FPN((4, 4), 4, FPNConfig(levels=2))
    for convolution in neck.modules():
        if isinstance(convolution, nn.Conv2d):
            nn.init.dirac_(convolution.weight)
    fine, coarse = torch.rand(1, 4, 4, 4), torch.rand(1, 4, 2, 2)
    fine_out, coarse_out = neck([fine, coarse])
    torch.testing.assert_close(coarse_out, coarse)
    torch.testing.assert_close(fine_out, fine + coarse.repeat_interleave(2, -1).repeat_interleave(2, -2))
