"""Distillation: a teacher sees the clips before augmentation, and its BEV maps are what a model learns."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from painted_drives import CONFIG, PaintedDrives

from bevcli.errors import WeightsError
from bevcli.model.bevformer.bevformer import BEVFormer
from bevcli.training.augmentation import AugmentationConfig
from bevcli.training.files import save_weights
from bevcli.training.frame_losses import DistillationLossConfig, Teacher
from bevcli.training.job import TrainingConfig, TrainingJob
from bevcli.training.samples import Batch, Clip, ClipConfig, load_batch
from bevcli.training.trainer import Trainer, forward_clip

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
    return load_batch(drives, both, CONFIG, augmentation, np.random.default_rng(1), learn_all=True, plain=True)


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
    taught = list(Teacher(other, str(weights), torch_device).bev_maps(batch))
    assert len(taught) == 2
    expected = [outputs.bev for outputs in forward_clip(model, batch, learn_all=True, freeze_batch_norm=True)]
    for one, two in zip(taught, expected, strict=True):
        torch.testing.assert_close(one, two, atol=1e-4, rtol=1e-4)


def test_a_model_learns_from_a_teacher(weights: Path, tmp_path: Path) -> None:
    loss = DistillationLossConfig(weight=100.0, teacher=str(weights))
    settings = TrainingConfig(
        steps=8, held_out=0, evaluate_every=8, clips=ClipConfig(2, 2, 0.0, "all"), augmentation=NOISE,
        distillation_loss=loss,
    )  # fmt: skip
    settings = replace(settings, optimizer=replace(settings.optimizer, learning_rate=1e-3, warm_up_steps=1))
    torch.manual_seed(1)
    drives = PaintedDrives(2, all_labelled=True)
    Trainer(TrainingJob(BEVFormer(CONFIG), settings, drives, drives, tmp_path, torch.device("cpu"))).run()
    with (tmp_path / "loss.csv").open() as file:
        losses = [float(row["distillation"]) for row in csv.DictReader(file)]
    assert losses[-1] < 0.8 * losses[0]


def test_missing_weights_of_a_teacher_are_said(model: BEVFormer) -> None:
    with pytest.raises(WeightsError, match=r"nowhere\.safetensors"):
        Teacher(model, "nowhere.safetensors", torch.device("cpu"))


@pytest.mark.parametrize("wrong", [{"weight": -1.0}, {"weight": 1.0}])
def test_a_weight_needs_a_teacher(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="teacher must name weights"):
        DistillationLossConfig(**wrong)
