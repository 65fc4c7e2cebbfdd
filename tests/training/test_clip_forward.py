"""The forward passes of a clip, which equal inference, also with frozen stages; and distillation from a teacher."""

import csv
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from painted_drives import CONFIG, PaintedDrives, batch_of

from bevcli.checkpoints import load_weights
from bevcli.config import TRAINING, as_table, as_toml as toml_of, known_models, load_config, load_table
from bevcli.errors import ConfigError, WeightsError
from bevcli.inference.preprocess import Preprocessor
from bevcli.model.bevformer import BEVFormer
from bevcli.model.efficientnet_lite import EfficientNetLiteConfig
from bevcli.model.fpn import FPNConfig
from bevcli.model.network import build_network
from bevcli.model.resnet import ResNet, ResNetConfig
from bevcli.model.temporal_model import build_model
from bevcli.workshop.bevformer_v2 import NO_EGO_MOTION, BEVFormerV2Config, BevFusionConfig
from bevcli.workshop.training.augmentation import AugmentationConfig, RandomisationConfig
from bevcli.workshop.training.frame_losses import DistillationLossConfig, Teacher
from bevcli.workshop.training.job import ProcessGroup, TrainingConfig, TrainingJob
from bevcli.workshop.training.samples import Batch, Clip, ClipConfig
from bevcli.workshop.training.trainer import FrozenStages, Trainer, forward_clip, save_weights

V1 = replace(CONFIG, heads=("detection",))
WINDOW = BEVFormerV2Config(
    **{field.name: getattr(V1, field.name) for field in fields(V1)}
    | {"ego_motion": NO_EGO_MOTION, "neck": FPNConfig(2)},  # the second level is for the perspective head only
    frames=(-1, 0),
    fusion=BevFusionConfig(blocks=1, width=64),
)
CPU = torch.device("cpu")


def clips_of(config: BEVFormerV2Config, frames: int = 2) -> Batch:
    """Clips of three drives, which is not the number of cameras."""
    clips = [Clip(drive, tuple(range(2 - frames, 2))) for drive in range(3)]
    drives = PaintedDrives(3, all_labelled=True)
    return batch_of(drives, clips, config, learn_all=True)


@pytest.mark.parametrize("config", [V1, WINDOW], ids=["BEVFormer", "BEVFormerV2"])
@pytest.mark.parametrize("learn_all", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_clip_gives_the_outputs_of_inference(config: BEVFormerV2Config, *, learn_all: bool) -> None:
    """With batch norms in evaluation mode, and without dropout."""
    torch.manual_seed(0)
    model = build_model(config).eval()
    outputs = list(forward_clip(model, clips_of(config), learn_all=learn_all, freeze_batch_norm=True))
    assert len(outputs) == (2 if learn_all else 1)
    model.eval()
    drives = PaintedDrives(3, all_labelled=True)
    for drive in range(3):
        memory = None
        for index in range(2):
            prepared = Preprocessor(config)(drives.open(drive).load(index))
            with torch.no_grad():
                expected, memory = model.step(prepared, memory, ())
            place = index if learn_all else index - 1
            if place >= 0:
                torch.testing.assert_close(outputs[place].bev[drive], expected.bev[0], atol=2e-4, rtol=0)
                codes = outputs[place].box_codes[:, drive]
                torch.testing.assert_close(codes, expected.box_codes[:, 0], atol=2e-3, rtol=0)


def test_the_earlier_frame_of_a_window_counts_without_gradient() -> None:
    torch.manual_seed(0)
    model, batch = build_model(WINDOW), clips_of(WINDOW)
    black = replace(batch.inputs[0], images=torch.zeros_like(batch.inputs[0].images))
    moved = batch.world_from_bev.clone()
    moved[0, :, 0, 3] += 5
    with torch.no_grad():
        whole, changed, elsewhere = (
            next(forward_clip(model, one, freeze_batch_norm=True)).bev
            for one in (batch, replace(batch, inputs=(black, batch.inputs[1])), replace(batch, world_from_bev=moved))
        )
    assert (whole - changed).abs().max() > 1e-3
    assert (whole - elsewhere).abs().max() > 1e-3
    batch.inputs[0].images.requires_grad_()
    batch.inputs[1].images.requires_grad_()
    next(forward_clip(model, batch)).bev.square().sum().backward()
    assert batch.inputs[0].images.grad is None
    assert batch.inputs[1].images.grad.any()


def test_a_window_that_clips_cannot_fill_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"training.clips.frames must be at least 2, .* but is 1"):
        WINDOW.check_training(1)
    with pytest.raises(ConfigError, match=r"frames after the current one cannot be trained; .* found \[0, 1\]"):
        replace(WINDOW, frames=(0, 1)).check_training(2)
    for name, architecture in (("uniad-track-map", "UniAD"), ("vad-tiny", "VAD")):
        with pytest.raises(ConfigError, match=rf"{name}: a {architecture} cannot be trained; expected a BEVFormer"):
            load_config(name).check_training(2)
    V1.check_training(1)


@pytest.mark.parametrize("name", [name for name in known_models() if name.startswith("v2-")])
def test_published_windows_train_with_perspective_supervision(name: str) -> None:
    settings = load_table(name, TRAINING, TrainingConfig)
    load_config(name).check_training(settings.clips.frames)
    assert settings.perspective_loss.weight > 0


def made_backbone() -> ResNet:
    torch.manual_seed(3)
    backbone = ResNet(ResNetConfig(blocks=(1, 2, 1, 1), output_stages=(2, 3), width=8))
    for name, values in backbone.named_buffers():
        if "running" in name:
            values.uniform_(0.5, 1.5)
    for parameter in backbone.parameters():
        if parameter.ndim == 1:
            torch.nn.init.uniform_(parameter, 0.5, 1.5)
    return backbone.eval()


def test_frozen_stages_give_the_same_maps_and_gradients() -> None:
    backbone, images = made_backbone(), torch.randn(3, 3, 64, 96)
    backbone.freeze(2)
    frozen = FrozenStages(backbone, 2, torch.float32)
    results = []
    for context in (frozen.used_by(backbone), torch.enable_grad()):
        with context:
            maps = backbone(images)
        backbone.zero_grad()
        maps[-1].square().mean().backward()
        gradients = [parameter.grad for parameter in backbone.parameters() if parameter.grad is not None]
        results.append([*maps, *gradients])
    assert len(results[0]) > 8
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)
    assert backbone.frozen_maps is None


def test_more_frozen_stages_than_the_backbone_has_are_all_of_it() -> None:
    backbone, images = made_backbone(), torch.randn(1, 3, 64, 96)
    with FrozenStages(backbone, 4, torch.float32).used_by(backbone):
        found = backbone(images)
    for one, expected in zip(found, backbone(images), strict=True):
        torch.testing.assert_close(one, expected, rtol=1e-3, atol=1e-4)
        assert not one.requires_grad


def test_several_processes_leave_frozen_parts_without_gradient(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a gradient of zero, weight decay would change them."""
    monkeypatch.setattr("torch.distributed.all_reduce", lambda sums: sums.mul_(2))
    layers = torch.nn.ModuleList(torch.nn.Linear(2, 2) for _ in range(3))
    layers[0].requires_grad_(False)
    layers[1].weight.grad = torch.ones(2, 2)
    ProcessGroup(0, 2).average_gradients(layers)
    assert [parameter.grad for parameter in layers[0].parameters()] == [None, None]
    assert layers[1].weight.grad.equal(torch.ones(2, 2))
    assert not layers[2].weight.grad.any()


NOISE = AugmentationConfig(photometric=0, grid_mask=0, noise=60.0)
PLAIN = AugmentationConfig(photometric=0, grid_mask=0)


@pytest.fixture(scope="module")
def model() -> BEVFormer:
    torch.manual_seed(0)
    return BEVFormer(CONFIG).eval()


@pytest.fixture(scope="module")
def weights(model: BEVFormer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("teacher") / "weights.safetensors"
    save_weights(file, model, torch.float32)
    return file


def clips(augmentation: AugmentationConfig) -> Batch:
    drives = PaintedDrives(2, all_labelled=True)
    both = [Clip(0, (0, 1)), Clip(1, (0, 1))]
    return batch_of(drives, both, CONFIG, augmentation, 1, learn_all=True, plain=True)


def test_a_teacher_sees_the_clips_before_augmentation() -> None:
    plain, noisy = clips(PLAIN), clips(NOISE)
    for seen, shown in zip(noisy.inputs, plain.inputs, strict=True):
        assert not torch.equal(seen.images, shown.images)
    assert noisy.plain is not None
    for taught, shown in zip(noisy.plain.inputs, plain.inputs, strict=True):
        assert torch.equal(taught.images, shown.images)


def test_a_teacher_gives_the_maps_of_its_weights(model: BEVFormer, weights: Path) -> None:
    batch, torch_device = clips(PLAIN), torch.device("cpu")
    torch.manual_seed(1)
    other = BEVFormer(CONFIG)
    lessons = list(Teacher(other, DistillationLossConfig(1.0, 0.0, str(weights)), torch_device).lessons(batch))
    assert len(lessons) == 2
    taught = [lesson.bev for lesson in lessons]
    expected = [outputs.bev for outputs in forward_clip(model, batch, learn_all=True, freeze_batch_norm=True)]
    for one, two in zip(taught, expected, strict=True):
        torch.testing.assert_close(one, two, atol=1e-4, rtol=1e-4)


@pytest.mark.slow
def test_a_model_learns_from_a_teacher(weights: Path, tmp_path: Path) -> None:
    losses = learned(DistillationLossConfig(weight=100.0, teacher=str(weights)), NOISE, tmp_path, "distillation")
    assert losses[-1] < 0.8 * losses[0]


def learned(loss: DistillationLossConfig, augmentation: AugmentationConfig, out: Path, name: str) -> list[float]:
    """The loss of that name after each step of a training."""
    settings = TrainingConfig(
        steps=8, held_out=0, evaluate_every=8, clips=ClipConfig(2, 2, 0.0, "all"), augmentation=augmentation,
        distillation_loss=loss,
    )  # fmt: skip
    settings = replace(settings, optimizer=replace(settings.optimizer, learning_rate=1e-3, warm_up_steps=1))
    torch.manual_seed(1)
    drives = PaintedDrives(2, all_labelled=True)
    list(Trainer(TrainingJob(BEVFormer(CONFIG), settings, drives, drives, out, torch.device("cpu"))).run())
    with (out / "loss.csv").open() as file:
        return [float(row[name]) for row in csv.DictReader(file)]


def test_missing_weights_of_a_teacher_are_said(model: BEVFormer) -> None:
    with pytest.raises(WeightsError, match=r"nowhere\.safetensors"):
        Teacher(model, DistillationLossConfig(1.0, teacher="nowhere.safetensors"), torch.device("cpu"))


@pytest.fixture(scope="module")
def other_teacher(tmp_path_factory: pytest.TempPathFactory) -> DistillationLossConfig:
    """A teacher with another backbone and another normalisation of images."""
    folder = tmp_path_factory.mktemp("other-teacher")
    image = replace(CONFIG.image, mean=(127.0, 120.0, 130.0), std=(128.0, 64.0, 100.0), color_order="bgr")
    config = replace(CONFIG, name="other", image=image, backbone=EfficientNetLiteConfig(output_stages=(4,)))
    (folder / "other.toml").write_text(toml_of(as_table(config)))
    torch.manual_seed(5)
    save_weights(folder / "other.safetensors", BEVFormer(config), torch.float32)
    return DistillationLossConfig(0.0, 1.0, str(folder / "other.safetensors"), str(folder / "other.toml"))


@pytest.mark.slow
def test_a_teacher_of_another_normalisation_sees_the_same_images(
    model: BEVFormer, other_teacher: DistillationLossConfig
) -> None:
    teacher, batch = Teacher(model, other_teacher, torch.device("cpu")), clips(NOISE)
    own = load_config(other_teacher.model)
    with torch.no_grad():
        for lesson, inputs in zip(teacher.lessons(batch), batch.inputs, strict=True):
            assert lesson.bev is None
            mean, std = (torch.tensor(x)[:, None, None] for x in (CONFIG.image.mean, CONFIG.image.std))
            pixels = (inputs.images * std + mean).flip(-3)
            own_mean, own_std = (torch.tensor(x)[:, None, None] for x in (own.image.mean, own.image.std))
            images = (pixels - own_mean) / own_std
            images[..., 72:, :] = 0  # padding
            network = build_network(own).eval()
            load_weights(Path(other_teacher.teacher), network)
            expected = network.neck(network.backbone(images.flatten(0, 1)))
            for one, two in zip(lesson.features, expected, strict=True):
                torch.testing.assert_close(one, two, atol=1e-4, rtol=1e-3)


@pytest.mark.slow
def test_a_model_learns_the_features_of_a_teacher(other_teacher: DistillationLossConfig, tmp_path: Path) -> None:
    augmentation = replace(NOISE, randomisation=RandomisationConfig(convolution=0.5, contrast=0.5))
    losses = learned(replace(other_teacher, feature_weight=100.0), augmentation, tmp_path, "features")
    assert losses[-1] < 0.8 * losses[0]
    assert 50 < losses[0] < 300  # relative to the variance of the teacher's features


def test_a_teacher_with_other_maps_is_refused(model: BEVFormer, other_teacher: DistillationLossConfig) -> None:
    finer = BEVFormer(replace(CONFIG, backbone=replace(CONFIG.backbone, output_stages=(2,))))
    with pytest.raises(ConfigError, match=r"cannot teach painted: it has .* 6 x 8 cells, .*expected .* 12 x 16 cells"):
        Teacher(finer, other_teacher, torch.device("cpu"))


@pytest.mark.parametrize("wrong", [{"weight": 1.0}, {"feature_weight": 1.0}])
def test_a_weight_needs_a_teacher(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="teacher must name weights"):
        DistillationLossConfig(**wrong)
