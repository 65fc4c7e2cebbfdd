"""NanoDet-g: the network, the weights of the package, frozen in a training, the fast forms, and boxes in the images."""

import random

import nanodet as program
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from small_model import small_config, small_inputs, small_model
from torch import Tensor

from bevcli.config import as_table, config_of_table
from bevcli.errors import ConfigError, InputError
from bevcli.model.fpn import FPNConfig
from bevcli.model.nanodet import NanoDet, NanoDetConfig
from bevcli.model.prepare import prepare_for_inference
from bevcli.workshop.training.trainer import FrozenStages

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


def made_backbone(**settings: object) -> NanoDet:
    """With the weights of the made-up package, in evaluation mode."""
    state = program.backbone_state(*made_graph(made_convolutions()))
    backbone = NanoDetConfig(**settings).build().eval()  # type: ignore[arg-type]
    backbone.load_state_dict({key.removeprefix("backbone."): x for key, x in state.items()})
    return backbone


@pytest.fixture(scope="module")
def backbone() -> NanoDet:
    return made_backbone()


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
def test_a_prepared_model_gives_the_same_features(backbone, precision, tolerance, levels) -> None:
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
