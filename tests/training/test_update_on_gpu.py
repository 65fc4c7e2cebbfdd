"""An update of a training on a simulated GPU: nothing is on the wrong device, and the CPU waits as seldom as stated."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from painted_drives import CONFIG, PaintedDrives
from simulated_device import provide_training, simulated

from bevcli.model.bevformer import BEVFormer
from bevcli.workshop.training.augmentation import AugmentationConfig, RandomisationConfig
from bevcli.workshop.training.frame_losses import DistillationLossConfig, PerspectiveLossConfig
from bevcli.workshop.training.job import OptimizerConfig, TrainingConfig, TrainingJob
from bevcli.workshop.training.losses import DenseLossConfig
from bevcli.workshop.training.samples import ClipConfig
from bevcli.workshop.training.trainer import Trainer, save_weights

PLAIN = TrainingConfig(
    steps=1, clips=ClipConfig(frames=2, batch=2, learn="all", short_share=0.0), augmentation=AugmentationConfig(0, 0)
)
CHANGED = AugmentationConfig(1.0, 0.5, exposure=0.5, randomisation=RandomisationConfig(1.0, 1.0, 1.0, 1.0, 1.0, 1.0))
ALL_PARTS = replace(
    PLAIN,
    frozen_stages=1,
    augmentation=CHANGED,
    optimizer=OptimizerConfig(average=0.9),
    dense_loss=DenseLossConfig(1.0, 1.5),
    perspective_loss=PerspectiveLossConfig(weight=1.0),
)


def losses(settings: TrainingConfig, out: Path, device: torch.device, waits: list[str]) -> list[tuple[float, Any]]:
    """Of all updates; and the operations of each for which the CPU waited. It ends with a validation."""
    found: list[tuple[float, Any]] = []
    torch.manual_seed(0)
    model, drives = BEVFormer(CONFIG), PaintedDrives(2, all_labelled=True)
    save_weights(out / "teacher.safetensors", model, torch.float32)
    if settings.frozen_stages:
        taught = DistillationLossConfig(1.0, 1.0, str(out / "teacher.safetensors"))
        settings = replace(settings, distillation_loss=taught)
    trainer = Trainer(TrainingJob(model, settings, drives, drives, out, device, seed=0))
    waits.clear()
    for progress in trainer.run():
        if progress.loss is not None:
            found.append((progress.loss, tuple(waits)))
            waits.clear()
    assert len(found) == 2
    assert (out / "weights.safetensors").exists()
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings", [pytest.param(PLAIN, id="plain"), pytest.param(ALL_PARTS, id="all parts", marks=pytest.mark.slow)]
)
def test_an_update_waits_for_matchings_and_numbers_only(settings, tmp_path, monkeypatch) -> None:
    """The costs of all frames of a batch are read at once, for boxes and for masks; the numbers of an update are read
    once, after the next one was begun."""
    expected = losses(settings, tmp_path, torch.device("cpu"), [])
    with simulated("cuda:0", monkeypatch, lambda *_, **__: None) as device:
        provide_training(device, monkeypatch)
        found = losses(settings, tmp_path, device.device, device.waits)
    # Images travel as bytes to a GPU.
    assert [loss for loss, _ in found] == pytest.approx([loss for loss, _ in expected], rel=0.02)
    found_waits = sorted(wait for _, waits in found for wait in waits)
    assert found_waits == sorted(len(found) * ["cpu", "cpu", "event"])


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU")
def test_a_real_gpu_has_the_losses_of_the_cpu(tmp_path) -> None:
    settings = replace(ALL_PARTS, augmentation=PLAIN.augmentation)  # noise is drawn on the device
    expected, found = (losses(settings, tmp_path, torch.device(name), []) for name in ("cpu", "cuda:0"))
    assert [loss for loss, _ in found] == pytest.approx([loss for loss, _ in expected], rel=0.03)
