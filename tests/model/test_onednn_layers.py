"""oneDNN's layers compute the same as PyTorch's."""

import copy
import threading

import pytest
import torch
from small_model import small_inputs, small_model
from torch import nn

from bevcli.model.backbone import Stage
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution
from bevcli.model.kernels import onednn as onednn_layers
from bevcli.model.kernels.choose import change_classes, fold_batch_norms
from bevcli.model.kernels.compiled import CompiledDeformableConvolution, CompiledPool, load_compiled
from bevcli.model.kernels.onednn import (
    FusedBlock,
    PackedConvolution,
    PackedLinear,
    has_matrix_unit,
    has_onednn,
    use_onednn,
)
from bevcli.model.prepare import prepare_for_inference
from bevcli.model.resnet import Bottleneck, ResNet, ResNetConfig

pytestmark = pytest.mark.skipif(not has_onednn(torch.float32), reason="this build of PyTorch has no oneDNN")
TOLERANCE = {torch.float32: 1e-4, torch.bfloat16: 0.1}


def dtypes() -> list[torch.dtype]:
    return [dtype for dtype in TOLERANCE if has_onednn(dtype)]


@pytest.mark.parametrize("rows", [(0,), (1,), (2, 900)])
@pytest.mark.parametrize("bias", [True, False])
def test_a_packed_linear_layer_equals_a_linear_layer(rows, bias):
    for dtype in dtypes():
        linear = nn.Linear(48, 20, bias).to(dtype)
        x = torch.randn(*rows, 48, dtype=dtype)
        with torch.inference_mode():
            found = PackedLinear(linear)(x)
            torch.testing.assert_close(found, linear(x), atol=TOLERANCE[dtype], rtol=TOLERANCE[dtype])


@pytest.mark.parametrize("style", ["pytorch", "caffe"])
@pytest.mark.parametrize(("in_channels", "stride"), [(64, 1), (32, 2)])
@pytest.mark.parametrize("deformable", [False, True])
def test_a_fused_bottleneck_equals_a_bottleneck(style, in_channels, stride, deformable):
    for dtype in dtypes():
        block = Bottleneck(in_channels, 16, stride, style, deformable)
        for name, module in list(block.named_modules()):
            if isinstance(module, nn.BatchNorm2d):  # as after folding, with biases in the convolutions
                block.set_submodule(name, nn.Identity())
            elif isinstance(module, nn.Conv2d):
                module.bias = nn.Parameter(torch.randn(len(module.weight)))
        if isinstance(block.conv2, ModulatedDeformableConvolution):
            block.conv2.bias = nn.Parameter(torch.randn(16))
            block.conv2 = CompiledDeformableConvolution(block.conv2)
        block = block.to(dtype).to(memory_format=torch.channels_last).requires_grad_(False)
        x = torch.randn(2, in_channels, 12, 20, dtype=dtype).to(memory_format=torch.channels_last)
        before = x.clone()
        with torch.inference_mode():
            expected = block(x)
            for whole in (nn.Sequential(copy.deepcopy(block)), Stage(nn.Identity(), copy.deepcopy(block))):
                use_onednn(whole)
                assert isinstance(whole[-1], FusedBlock)
                torch.testing.assert_close(whole(x), expected, atol=TOLERANCE[dtype], rtol=TOLERANCE[dtype])
                overwrites = isinstance(whole, Stage) and isinstance(block.downsample, nn.Identity)
                assert torch.equal(x, before) == (not overwrites)


@pytest.mark.parametrize("groups", [1, 4])
def test_a_packed_convolution_takes_inputs_of_every_size(groups):
    for dtype in dtypes():
        plain = nn.Conv2d(16, 24, 3, stride=2, padding=1, dilation=2, groups=groups).to(dtype).requires_grad_(False)
        packed = nn.Sequential(copy.deepcopy(plain))
        use_onednn(packed)
        assert isinstance(packed[0], PackedConvolution)
        for batch, height, width in ((6, 15, 25), (1, 15, 25), (2, 8, 40), (6, 15, 25)):
            x = torch.randn(batch, 16, height, width, dtype=dtype)
            with torch.inference_mode():
                torch.testing.assert_close(packed(x), plain(x), atol=TOLERANCE[dtype], rtol=TOLERANCE[dtype])


def test_residual_blocks_do_not_write_over_returned_maps():
    backbone = ResNet(ResNetConfig((2, 2, 2, 2), output_stages=(1, 2, 3, 4), width=8)).eval().requires_grad_(False)
    for module in backbone.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.normal_(module.weight)
    fold_batch_norms(backbone, torch.device("cpu"))
    fast, images = nn.Sequential(copy.deepcopy(backbone)), torch.randn(2, 3, 64, 96)
    use_onednn(fast)
    before = images.clone()
    with torch.inference_mode():
        torch.testing.assert_close(fast(images), backbone(images), atol=1e-4, rtol=1e-4)
    assert torch.equal(images, before)


def test_without_onednn_a_model_keeps_its_layers(monkeypatch):
    model, cpu = small_model(), torch.device("cpu")
    with torch.inference_mode():
        expected = prepare_for_inference(model, cpu)(small_inputs(0)).bev
        monkeypatch.setattr(onednn_layers, "has_onednn", lambda dtype: False)
        kept = prepare_for_inference(model, cpu)
        assert not any(isinstance(module, PackedLinear | FusedBlock) for module in kept.modules())
        torch.testing.assert_close(kept(small_inputs(0)).bev, expected, atol=1e-4, rtol=1e-4)


def test_rounded_products_are_close_and_leave_no_setting_behind():
    linear, x = nn.Linear(256, 64), torch.randn(900, 256)
    setting = getattr(torch.backends.mkldnn, "matmul", None)
    before = getattr(setting, "fp32_precision", None)
    with torch.inference_mode():
        found = PackedLinear(linear, rounds=has_matrix_unit())(x)
        torch.testing.assert_close(found, linear(x), atol=0.02, rtol=0.02)
        assert found.dtype == torch.float32
    assert getattr(setting, "fp32_precision", None) == before


def test_layers_that_predict_positions_are_not_rounded():
    model = small_model().eval().requires_grad_(False)
    fold_batch_norms(model, torch.device("cpu"))
    use_onednn(model, rounds=True)
    rounded = {name for name, part in model.named_modules() if getattr(part, "rounds", False)}
    assert any(name.startswith("encoder.layers.0.feed_forward") for name in rounded)
    assert any(name.startswith("detection_head.class_branches") for name in rounded)
    assert not [name for name in rounded if "box_branches" in name or "reference_points" in name]


@pytest.mark.parametrize("size", [(8, 12), (7, 5), (1, 1)])
def test_a_compiled_pool_and_a_relu_equal_the_plain_ones(size):
    plain, loaded = nn.MaxPool2d(3, stride=2, padding=1), threading.Event()
    change_classes(compiled := copy.deepcopy(plain), {nn.MaxPool2d: CompiledPool}, loaded=loaded)
    for dtype in (torch.float32, torch.bfloat16, torch.float16):
        x = torch.randn(2, 24, *size).to(dtype)
        expected = plain(x.float()).relu().to(dtype)
        loaded.clear()
        assert torch.equal(compiled(x).relu(), expected)
        loaded.set()
        assert torch.equal(compiled(x).relu(), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_all_loops_of_a_data_type_are_loaded(dtype):
    loaded = threading.Event()
    load_compiled(dtype, loaded)
    assert loaded.is_set()  # it raises nothing, so a mistake would only cost time
