"""The training loop: clips in, a step of the optimizer, checkpoints and curves out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from bevcli.errors import BevcliError
from bevcli.model.bevformer import BEVFormer
from bevcli.model.prepared import choose_kernels
from bevcli.pipeline.model_loading import choose_precision
from bevcli.pipeline.read_ahead import read_ahead
from bevcli.pipeline.runner import Runner, StepOptions
from bevcli.training.augmentation import AugmentationConfig
from bevcli.training.checkpoint import load_checkpoint, save_checkpoint, save_weights
from bevcli.training.clips import ClipConfig, draw_clips
from bevcli.training.drives import Drives
from bevcli.training.frame_losses import FrameLosses, LossConfigs
from bevcli.training.learning_curves import Curve, draw
from bevcli.training.optimizer import OptimizerConfig, clip_gradients, make_optimizer, set_rate
from bevcli.training.recurrent_clip import forward_clip
from bevcli.training.samples import Batch, load_batch
from bevcli.training.team import Team
from bevcli.training.validation import Validation, validate

T = TypeVar("T")


@dataclass(frozen=True)
class TrainingConfig(LossConfigs):
    """The [training] table of a model's file.

    steps: batches of clips. held_out: how many of the drives, the last ones, are for evaluation only.
    evaluate_every, checkpoint_every: steps. freeze_batch_norm: for fine-tuning, keep the running statistics.
    loaders: threads that each read one step's batches ahead; more than one where a GPU waits for them.
    weights_dtype: of weights.safetensors.
    """

    steps: int = 10_000
    held_out: int = 2
    evaluate_every: int = 1000
    checkpoint_every: int = 250
    freeze_batch_norm: bool = False
    loaders: int = 1
    weights_dtype: Literal["float32", "float16"] = "float32"
    clips: ClipConfig = field(default_factory=ClipConfig)
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)

    def __post_init__(self) -> None:
        if min(self.steps, self.evaluate_every, self.checkpoint_every, self.loaders) < 1 or self.held_out < 0:
            raise ValueError(
                "steps, evaluate_every, checkpoint_every and loaders must be positive, held_out not negative"
            )


@dataclass(frozen=True)
class TrainingJob:
    """drives: to learn from. held_out: to evaluate on; empty to evaluate on `drives`. out: a folder that exists.

    seed: decides everything that is drawn, together with the number of the step and the place in the team.
    """

    model: BEVFormer
    config: TrainingConfig
    drives: Drives
    held_out: Drives
    out: Path
    device: torch.device
    seed: int = 0
    team: Team = field(default_factory=Team)


class Trainer:
    """A training that can be stopped at any time and resumed at its last checkpoint.

    Writes checkpoint.pt, weights.safetensors, loss.csv, validation.csv and curves.png.
    """

    def __init__(self, job: TrainingJob, *, resume: bool = False) -> None:
        self.job = job
        options = StepOptions(choose_precision(None, job.device), temporal=job.config.clips.frames > 1)
        self.runner = Runner(job.model, job.device, options)
        self.losses = FrameLosses(job.model, job.config)
        # All that learns: the model, and what reads it in training only.
        self.learning = nn.ModuleDict({"model": job.model, **self.losses.readers}).to(job.device)
        self.optimizer = make_optimizer(self.learning, job.model.backbone, job.config.optimizer)
        checkpoint = job.out / "checkpoint.pt"
        self.done = load_checkpoint(checkpoint, self.learning, self.optimizer) if resume else 0
        choose_kernels(job.model, job.device, gradients=True)
        if job.team.leads:
            self.loss_curve = Curve(job.out / "loss.csv", self.done)
            self.validation_curve = Curve(job.out / "validation.csv", self.done)

    def run(
        self,
        after_step: Callable[[], None] = lambda: None,
        after_validation: Callable[[int, Validation], None] = lambda step, scores: None,
    ) -> None:
        """All steps that are left. Raises BevcliError where the loss is no number any more."""
        config = self.job.config
        left = range(self.done, config.steps)
        for batches in read_ahead(self._load, left, depth=config.loaders, threads=config.loaders):
            row = self._step(batches)
            self.done += 1
            if not self.job.team.leads:
                continue
            self.loss_curve.add(self.done, row)
            last = self.done == config.steps
            if self.done % config.evaluate_every == 0 or last:
                after_validation(self.done, self._validate())
            if self.done % config.checkpoint_every == 0 or last:
                save_checkpoint(self.job.out / "checkpoint.pt", self.done, self.learning, self.optimizer)
            after_step()

    def _load(self, step: int) -> list[Batch]:
        """The batches that a step goes through side by side."""
        job, config = self.job, self.job.config
        random = np.random.default_rng(self._seeds(step))
        batches = []
        for _ in range(config.clips.in_turn):
            clips = draw_clips(job.drives, config.clips, random)
            batches.append(
                load_batch(
                    job.drives, clips, job.model.config, config.augmentation, random, learn_all=self._learns_all()
                )
            )
        return batches

    def _step(self, batches: list[Batch]) -> dict[str, float]:
        """One step, an update of the weights for each frame that is learned from; returns the mean row."""
        job, config = self.job, self.job.config
        torch.manual_seed(int(np.random.SeedSequence(self._seeds(self.done)).generate_state(1)[0]))  # for dropout
        rate = config.optimizer.learning_rate * config.optimizer.share(self.done, config.steps)
        set_rate(self.optimizer, rate)
        clips = [self._losses(batch.to(job.device)) for batch in batches]
        rows = [self._update(losses) for losses in _in_turn(clips)]
        job.team.average_statistics(self.learning)
        means = {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}
        norm = means.pop("gradient norm")
        return means | {"learning rate": rate, "gradient norm": norm}

    def _seeds(self, step: int) -> list[int]:
        """What decides chance in a step: another one for each process of a team."""
        place = self.job.team.place
        return [self.job.seed, step, place] if place else [self.job.seed, step]

    def _update(self, losses: dict[str, Tensor]) -> dict[str, float]:
        total = torch.stack(list(losses.values())).sum()
        if not math.isfinite(total.item()):
            raise BevcliError(
                f"step {self.done + 1}: the loss is {total.item()}; lower the learning rate, and --resume "
                f"from the last checkpoint in {self.job.out}"
            )
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        self.job.team.average_gradients(self.learning)
        norm = clip_gradients(self.learning, self.job.config.optimizer.max_gradient_norm)
        self.optimizer.step()
        return {"loss": total.item(), **{name: loss.item() for name, loss in losses.items()}, "gradient norm": norm}

    def _losses(self, batch: Batch) -> Iterator[dict[str, Tensor]]:
        """The losses of one frame after another; the model may be updated in between."""
        job, config = self.job, self.job.config
        frames = forward_clip(
            job.model, batch.steps, learn_all=self._learns_all(), freeze_batch_norm=config.freeze_batch_norm
        )
        learned = batch.steps[-len(batch.targets) :]
        for inputs, targets in zip(learned, batch.targets, strict=True):
            with torch.autocast(job.device.type, torch.bfloat16, enabled=computes_in_bfloat16(job.device)):
                outputs = next(frames)
            yield self.losses(inputs, outputs, targets)

    def _learns_all(self) -> bool:
        return self.job.config.clips.learn == "all"

    def _validate(self) -> Validation:
        job = self.job
        job.model.eval()
        scores = validate(self.runner, job.held_out if len(job.held_out) else job.drives)
        self.validation_curve.add(self.done, scores.row())
        dtype = torch.float16 if job.config.weights_dtype == "float16" else torch.float32
        save_weights(job.out / "weights.safetensors", job.model, dtype)
        draw(self.loss_curve, self.validation_curve, job.out / "curves.png")
        return scores


def _in_turn(iterators: list[Iterator[T]]) -> Iterator[T]:
    """The first of each, then the second of each, and so on."""
    left = list(iterators)
    while left:
        for iterator in tuple(left):
            try:
                yield next(iterator)
            except StopIteration:
                left.remove(iterator)


def computes_in_bfloat16(device: torch.device) -> bool:
    """Whether the device has instructions for it, so that mixed precision is the faster one."""
    return device.type == "cuda" or torch.cpu._is_avx512_bf16_supported()
