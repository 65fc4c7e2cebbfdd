"""The training loop: clips in; updates of the weights, checkpoints and learning curves out."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from bevcli.errors import BevcliError
from bevcli.model.bevformer_v2 import BEVFormerV2
from bevcli.model.prepared import choose_kernels
from bevcli.pipeline.cpu_memory import trim_memory
from bevcli.pipeline.model_loading import choose_precision
from bevcli.pipeline.read_ahead import read_ahead
from bevcli.pipeline.runner import Runner, StepOptions
from bevcli.training.checkpoint import load_checkpoint, save_checkpoint, save_weights
from bevcli.training.clip_forward import forward_clip
from bevcli.training.clips import draw_clips
from bevcli.training.frame_losses import FrameLosses
from bevcli.training.frozen_stages import FrozenStages
from bevcli.training.job import CHECKPOINT, TrainingJob
from bevcli.training.learning_curves import LearningCurve, draw_learning_curves
from bevcli.training.optimizer import clip_gradients, make_optimizer, set_learning_rate, update_average
from bevcli.training.samples import Batch, load_batch
from bevcli.training.validation import Validation, validate

T = TypeVar("T")


class Trainer:
    """A training that can be interrupted at any time and resumed from its last checkpoint.

    Writes checkpoint.pt, weights.safetensors, loss.csv, validation.csv and curves.png into the output folder.

    Attributes:
        job: what is trained, on what.
        trained: all modules that are trained: the model and the auxiliary heads.
        optimizer: of their parameters.
        done: the number of steps done.
    """

    def __init__(self, job: TrainingJob, *, resume: bool = False) -> None:
        """Prepares model and optimizer. Raises WeightsError if the checkpoint to resume from is missing or wrong."""
        self.job = job
        job.model.backbone.freeze(job.config.frozen_stages)
        self._losses = FrameLosses(job.model, job.config)
        self.trained = nn.ModuleDict({"model": job.model, **self._losses.auxiliary_heads}).to(job.device)
        self.optimizer = make_optimizer(self.trained, job.model.backbone, job.config.optimizer)
        self._average: dict[str, Tensor] | None = None
        if job.config.optimizer.average > 0:
            self._average = {key: value.detach().clone() for key, value in job.model.state_dict().items()}
        self.done = 0
        if resume:
            self.done = load_checkpoint(job.out / CHECKPOINT, self.trained, self.optimizer, self._average)
        choose_kernels(job.model, job.device, gradients=True)
        self._frozen: FrozenStages | None = None
        if job.config.frozen_stages and job.config.freeze_batch_norm:
            dtype = torch.bfloat16 if computes_in_bfloat16(job.device) else torch.float32
            self._frozen = FrozenStages(job.model.backbone, job.config.frozen_stages, dtype)
        if job.group.leads:
            self._loss_curve = LearningCurve(job.out / "loss.csv", self.done)
            self._validation_curve = LearningCurve(job.out / "validation.csv", self.done)

    def run(
        self,
        after_step: Callable[[], None] = lambda: None,
        after_validation: Callable[[int, Validation], None] = lambda step, scores: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Runs the remaining steps and leaves the model in evaluation mode. Raises BevcliError if a loss is not finite.

        Args:
            after_step: called by the leader after each step.
            after_validation: called by the leader with the number of steps done and the scores.
            stop: asked after each step; if it is true, a checkpoint is written and the training ends early.
        """
        config = self.job.config
        remaining = range(self.done, config.steps)
        for batches in read_ahead(self._load, remaining, depth=config.loaders, threads=config.loaders):
            row = self._step(batches)
            trim_memory()
            self.done += 1
            stopped = stop()
            if not self.job.group.leads:
                if stopped:
                    break
                continue
            self._loss_curve.add(self.done, row)
            last = self.done == config.steps
            if self.done % config.evaluate_every == 0 or last:
                after_validation(self.done, self._validate())
            if self.done % config.checkpoint_every == 0 or last or stopped:
                save_checkpoint(self.job.out / CHECKPOINT, self.done, self.trained, self.optimizer, self._average)
            after_step()
            if stopped:
                break
        self.job.model.eval()

    @property
    def _learn_all(self) -> bool:
        return self.job.config.clips.learn == "all"

    def _seeds(self, step: int) -> list[int]:
        """The seeds of a step's random draws; different for each process of a group."""
        rank = self.job.group.rank
        return [self.job.seed, step, rank] if rank else [self.job.seed, step]

    def _load(self, step: int) -> list[Batch]:
        """The batches of a step: `clips.in_turn` of them."""
        job, config = self.job, self.job.config
        random = np.random.default_rng(self._seeds(step))
        batches = []
        for _ in range(config.clips.in_turn):
            clips = draw_clips(job.drives, config.clips, random, with_gap=not isinstance(job.model, BEVFormerV2))
            batches.append(
                load_batch(job.drives, clips, job.model.config, config.augmentation, random, learn_all=self._learn_all)
            )
        return batches

    def _step(self, batches: list[Batch]) -> dict[str, float]:
        """One step, with an update of the weights for each frame trained on. Returns the means for loss.csv."""
        job, config = self.job, self.job.config
        rate = config.optimizer.learning_rate_at(self.done, config.steps)
        set_learning_rate(self.optimizer, rate)
        gpus = [job.device] if job.device.type == "cuda" else []
        frozen = nullcontext() if self._frozen is None else self._frozen.used_by(job.model.backbone)
        with torch.random.fork_rng(gpus), self._losses.watching(job.model), frozen:
            torch.manual_seed(int(np.random.SeedSequence(self._seeds(self.done)).generate_state(1)[0]))  # for dropout
            clips = [self._clip_losses(batch.to(job.device)) for batch in batches]
            rows = [self._update(losses) for losses in alternated(clips)]
        job.group.average_statistics(self.trained)
        means = {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}
        norm = means.pop("gradient norm")
        return means | {"learning rate": rate, "gradient norm": norm}

    def _clip_losses(self, batch: Batch) -> Iterator[dict[str, Tensor]]:
        """The losses of each frame to train on, lazily: the model may be updated in between."""
        job, config = self.job, self.job.config
        outputs = forward_clip(job.model, batch, learn_all=self._learn_all, freeze_batch_norm=config.freeze_batch_norm)
        for inputs, targets in zip(batch.inputs[-len(batch.targets) :], batch.targets, strict=True):
            with torch.autocast(job.device.type, torch.bfloat16, enabled=computes_in_bfloat16(job.device)):
                output = next(outputs)
            yield self._losses(inputs, output, targets)

    def _update(self, losses: dict[str, Tensor]) -> dict[str, float]:
        """One update of the weights."""
        total = torch.stack(list(losses.values())).sum()
        if not math.isfinite(total.item()):
            raise BevcliError(
                f"step {self.done + 1}: the loss is {total.item()}; lower the learning rate, and --resume "
                f"from the last checkpoint in {self.job.out}"
            )
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        self.job.group.average_gradients(self.trained)
        norm = clip_gradients(self.trained, self.job.config.optimizer.max_gradient_norm)
        self.optimizer.step()
        if self._average is not None:
            update_average(self._average, self.job.model.state_dict(), self.job.config.optimizer.average)
        return {"loss": total.item(), **{name: loss.item() for name, loss in losses.items()}, "gradient norm": norm}

    def _validate(self) -> Validation:
        """Scores the model, writes its weights and the learning curves."""
        job = self.job
        options = StepOptions(choose_precision(None, job.device), temporal=job.config.clips.frames > 1)
        # A copy, because a Runner puts timing hooks on its model and switches it to evaluation mode.
        model = copy.deepcopy(job.model)
        if self._average is not None:
            model.load_state_dict(self._average)
        runner = Runner(model, job.device, options)
        scores = validate(runner, job.held_out if len(job.held_out) else job.drives)
        self._validation_curve.add(self.done, scores.row())
        dtype = torch.float16 if job.config.weights_dtype == "float16" else torch.float32
        save_weights(job.out / "weights.safetensors", model, dtype)
        draw_learning_curves(self._loss_curve, self._validation_curve, job.out / "curves.png")
        return scores


def alternated(iterators: Sequence[Iterator[T]]) -> Iterator[T]:
    """The first item of each iterator, then the second of each, and so on until all are exhausted."""
    remaining = list(iterators)
    while remaining:
        for iterator in tuple(remaining):
            try:
                yield next(iterator)
            except StopIteration:
                remaining.remove(iterator)


def computes_in_bfloat16(device: torch.device) -> bool:
    """Whether the device has bfloat16 instructions, so that mixed precision is faster."""
    return device.type == "cuda" or torch.cpu._is_avx512_bf16_supported()
