"""What a training is made from: the [training] table of a model file, a model, drives and an output folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch

from bevcli.checkpoints import load_weights
from bevcli.config import TRAINING, load_config, load_table
from bevcli.errors import ConfigError, OutputError
from bevcli.geometry.cameras import CameraRig
from bevcli.model.bevformer import BEVFormerBase, BEVFormerConfig
from bevcli.model.bevformer_v2 import BEVFormerV2Config
from bevcli.model.build import build_model
from bevcli.model.uniad import UniADConfig
from bevcli.synth.random_rig import RigDistribution
from bevcli.synth.rig import rig_for_rendering
from bevcli.training.augmentation import AugmentationConfig
from bevcli.training.clips import ClipConfig
from bevcli.training.drives import Drives, check_training_seeds, open_drives, split_drives
from bevcli.training.frame_losses import LossConfigs
from bevcli.training.optimizer import OptimizerConfig
from bevcli.training.process_group import ProcessGroup, join_process_group

CHECKPOINT = "checkpoint.pt"  # in the output folder


@dataclass(frozen=True)
class TrainingConfig(LossConfigs):
    """The [training] table of a model file.

    Attributes:
        steps: number of steps. A step draws one batch of clips, or `clips.in_turn` batches.
        held_out: the last drives, so many, are for evaluation only; 0 evaluates on the training drives.
        evaluate_every: steps between evaluations.
        checkpoint_every: steps between checkpoints.
        freeze_batch_norm: keep the running statistics of batch norms, for fine-tuning.
        frozen_stages: the backbone's stem and its first stages, so many, keep their weights; 0 trains all of it.
        loaders: threads that read batches ahead, one step's batches each. Use several if a GPU waits for data.
        weights_dtype: data type of weights.safetensors.
        clips: how clips are drawn.
        augmentation: image augmentation.
        rigs: the rigs of rendered drives.
        optimizer: AdamW and the learning rate schedule.
    """

    steps: int = 10_000
    held_out: int = 2
    evaluate_every: int = 1000
    checkpoint_every: int = 250
    freeze_batch_norm: bool = False
    frozen_stages: int = 0
    loaders: int = 1
    weights_dtype: Literal["float32", "float16"] = "float32"
    clips: ClipConfig = field(default_factory=ClipConfig)
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    rigs: RigDistribution = field(default_factory=RigDistribution)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)

    def __post_init__(self) -> None:
        if min(self.steps, self.evaluate_every, self.checkpoint_every, self.loaders) < 1 or self.held_out < 0:
            raise ValueError(
                "steps, evaluate_every, checkpoint_every and loaders must be positive, held_out not negative"
            )
        if self.frozen_stages < 0:
            raise ValueError("frozen_stages must not be negative")


@dataclass(frozen=True)
class TrainingJob:
    """Everything that a `Trainer` needs.

    Attributes:
        model: is trained in place.
        config: the [training] table.
        drives: to train on.
        held_out: to evaluate on; empty to evaluate on `drives`.
        out: the output folder, which exists.
        device: where to train.
        seed: determines all random draws, together with the step and the rank of the process.
        group: the processes that train together.
    """

    model: BEVFormerBase
    config: TrainingConfig
    drives: Drives
    held_out: Drives
    out: Path
    device: torch.device
    seed: int = 0
    group: ProcessGroup = field(default_factory=ProcessGroup)


def prepare_training(
    model_name_or_file: str,
    device: torch.device,
    *,
    folders: Sequence[Path] = (),
    rendered_seeds: Sequence[int] | None = None,
    out: Path | None = None,
    weights: Path | None = None,
    steps: int | None = None,
    held_out: int | None = None,
    seed: int = 0,
    resume: bool = False,
) -> TrainingJob:
    """A training job, ready for `Trainer`. Joins the other processes if torchrun started several.

    Initial weights are drawn from PyTorch's global generator: call torch.manual_seed before to reproduce them.

    Args:
        folders: sequence folders with ground truth.
        rendered_seeds: of rendered drives, in place of folders. They are kept in the output folder.
        out: the output folder, by default runs/train-MODEL.
        weights: a file to start from, in place of random weights.
        steps: replaces `steps` of the [training] table.
        held_out: replaces `held_out` of the [training] table.
        seed: of all draws after the initial weights.
        resume: the output folder may hold a checkpoint.

    Raises:
        BevcliError: a file, the choice of drives, or the output folder is wrong.
    """
    model_config = load_config(model_name_or_file)
    config = load_table(model_name_or_file, TRAINING, TrainingConfig)
    config = config if steps is None else replace(config, steps=steps)
    config = config if held_out is None else replace(config, held_out=held_out)
    check_window(model_config, config)
    out = Path("runs") / f"train-{model_config.name}" if out is None else out
    check_training_seeds(rendered_seeds or ())
    rigs = config.rigs if config.rigs.random_share > 0 else None
    drives = open_drives(folders, rendered_seeds, out / "drives", model_config, rigs)
    drives, evaluated = split_drives(drives, config.held_out)
    prepare_folder(out, resume=resume)
    model = build_model(model_config)
    if weights is not None:
        load_weights(weights, model, resample=True)
    return TrainingJob(model, config, drives, evaluated, out, device, seed, join_process_group(device))


def rig_for_drives(choice: str, model: str) -> CameraRig | RigDistribution:
    """The rig in a calibration.json, or for "random" the distribution of the [training.rigs] table of a model file.

    With "random" every drive has a random rig. Raises InputError or ConfigError where a file is wrong.
    """
    if choice == "random":
        return replace(load_table(model, TRAINING, TrainingConfig).rigs, random_share=1.0)
    return rig_for_rendering(choice, None)


def check_window(model: BEVFormerConfig, config: TrainingConfig) -> None:
    """Raises ConfigError if clips cannot fill the window of a BEVFormerV2, and for a UniAD."""
    if isinstance(model, UniADConfig):
        raise ConfigError(f"{model.name}: a UniAD cannot be trained; expected a BEVFormer, such as tiny, small or base")
    if not isinstance(model, BEVFormerV2Config):
        return
    if model.later_frames:
        raise ConfigError(
            f"{model.name}: frames after the current one cannot be trained; expected frames that end with 0, "
            f"found {list(model.frames)}"
        )
    if config.clips.frames <= model.past_frames:
        raise ConfigError(
            f"{model.name}: training.clips.frames must be at least {model.past_frames + 1}, so that a clip fills the "
            f"window of the model, but is {config.clips.frames}"
        )


def prepare_folder(out: Path, *, resume: bool) -> None:
    """Makes the output folder. Raises OutputError if it holds a training that is not to be resumed."""
    if (out / CHECKPOINT).exists() and not resume:
        raise OutputError(f"{out}: already holds a training; pass --resume to continue it, or --out DIR for a new one")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: cannot be made ({error.strerror})") from None
