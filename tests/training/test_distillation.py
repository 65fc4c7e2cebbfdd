"""Distillation: a model learns the BEV maps of a teacher, which sees clips without augmentation, or its features."""

import csv
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from painted_drives import CONFIG, PaintedDrives, batch_of

from bevcli.checkpoints import load_weights
from bevcli.config import as_table, as_toml as toml_of, load_config
from bevcli.errors import ConfigError, WeightsError
from bevcli.model.bevformer import BEVFormer
from bevcli.model.efficientnet_lite import EfficientNetLiteConfig
from bevcli.model.network import build_network
from bevcli.workshop.training.augmentation import AugmentationConfig, RandomisationConfig
from bevcli.workshop.training.frame_losses import DistillationLossConfig, Teacher
from bevcli.workshop.training.job import TrainingConfig, TrainingJob
from bevcli.workshop.training.samples import Batch, Clip, ClipConfig
from bevcli.workshop.training.trainer import Trainer, forward_clip, save_weights

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
