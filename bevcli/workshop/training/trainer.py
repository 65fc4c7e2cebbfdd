"""The training loop: clips in; updates of the weights, checkpoints and learning curves out. `train` and `validate`."""

import contextlib
import copy
import logging
import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice, product, repeat
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import safetensors.torch
import torch
from torch import Tensor, nn

from bevcli.config import TRAINING, load_table
from bevcli.errors import BevcliError, InputError, WeightsError
from bevcli.geometry.cameras import CameraRig
from bevcli.inference import ModelOptions, StepOptions
from bevcli.inference.load import Model, choose_device, choose_model, load_model
from bevcli.inference.machine import trim_memory
from bevcli.inference.runner import Runner
from bevcli.model.backbone import Backbone
from bevcli.model.config import ModelConfig, weights_facts
from bevcli.model.kernels import rounded_products
from bevcli.model.kernels.choose import fold_batch_norms
from bevcli.model.kernels.onednn import use_onednn
from bevcli.model.network import Network
from bevcli.model.step import ModelOutputs
from bevcli.options import refuse, spread
from bevcli.parsing.pth import read_pth
from bevcli.printing import counted, one_line
from bevcli.workshop.synth import DriveOptions
from bevcli.workshop.synth.drives import (
    Drives,
    FolderDrives as FolderDrives,
    FrameMemory,
    count_frames as count_frames,
    read_split,
    scored_drives,
)
from bevcli.workshop.synth.rig import RigDistribution, rig_for_rendering
from bevcli.workshop.training import TrainOptions, ValidationOptions
from bevcli.workshop.training.augmentation import randomised
from bevcli.workshop.training.frame_losses import FrameLosses, Lesson, Teacher
from bevcli.workshop.training.job import (
    CHECKPOINT,
    OptimizerConfig,
    TrainingConfig,
    TrainingJob,
    free_memory,
    prepare_training,
    trainings_here,
)
from bevcli.workshop.training.kernels import choose_training_kernels
from bevcli.workshop.training.samples import Batch, BatchMaker, loaded_batches, save
from bevcli.workshop.training.validation import (
    LearningCurve,
    Validation,
    check_scored_drives,
    draw_learning_curves,
    event_writer,
    score_drives,
)
from bevcli.writing import whole_file, write_whole

T = TypeVar("T")

FORMAT = "bevcli-training/1"
# What PyTorch raises for contents that belong to another model.
_DAMAGE = (RuntimeError, ValueError, LookupError, TypeError, AttributeError, OverflowError)

WEIGHTS = "weights.safetensors"  # in the output folder


def make_optimizer(trained: nn.Module, backbone: nn.Module, config: OptimizerConfig) -> torch.optim.AdamW:
    """AdamW with two parameter groups: everything in `trained` except the backbone, and the backbone.

    Frozen parameters get no gradient, so that it leaves them alone.
    """
    in_backbone = {id(parameter) for parameter in backbone.parameters()}
    others = [parameter for parameter in trained.parameters() if id(parameter) not in in_backbone]
    groups = [{"params": others, "share": 1.0}, {"params": list(backbone.parameters()), "share": config.backbone_share}]
    # On a GPU, fused: one kernel instead of hundreds.
    fused = next(trained.parameters()).device.type == "cuda" or None
    return torch.optim.AdamW(groups, lr=config.learning_rate, weight_decay=config.weight_decay, fused=fused)


@torch.no_grad()
def update_average(average: dict[str, Tensor], state: Mapping[str, Tensor], decay: float) -> None:
    """Moves a running average of a state dict towards it, in place; integers are copied."""
    moved = [key for key, value in state.items() if value.is_floating_point()]
    # PyTorch's optimizers call it too; the public `lerp_`, one tensor at a time, starts a kernel for each of them.
    torch._foreach_lerp_([average[key] for key in moved], [state[key] for key in moved], 1 - decay)
    for key in state.keys() - set(moved):
        average[key].copy_(state[key])


def forward_clip(
    model: Network, batch: Batch, *, learn_all: bool = False, freeze_batch_norm: bool = False
) -> Iterator[ModelOutputs]:
    """The outputs, in training mode, for the last frame of a batch of clips.

    The frames before it only build its history, in evaluation mode and without gradient, as in the papers. Of a model
    with a window of frames, this applies to the image features of the earlier frames.

    Args:
        learn_all: yield the outputs for every frame. The model may be updated in between: history has no gradient.
        freeze_batch_norm: keep batch norms in evaluation mode, for fine-tuning.
    """
    frames = len(batch.inputs)
    first_learned = 0 if learn_all else frames - 1
    memory = None
    model.eval()
    with torch.no_grad():
        for frame in range(first_learned):
            memory = model.history_of_clip(batch, frame, memory)
    model.train()
    for module in model.modules():
        if freeze_batch_norm and isinstance(module, nn.BatchNorm2d):
            module.eval()
    for frame in range(first_learned, frames):
        outputs, memory = model.outputs_of_clip(batch, frame, memory)
        yield outputs


class FrozenStages:
    """A copy of the stem and the first stages of a backbone, computed as in inference: faster, the same results.

    Batch norms are folded into their convolutions and, on a CPU, oneDNN runs the residual blocks, one image at a time,
    whose feature maps fit into the caches.
    """

    def __init__(self, backbone: Backbone, stages: int, dtype: torch.dtype) -> None:
        """stages: how many, from the first. dtype: of the computation and its results."""
        self._device = next(backbone.parameters()).device
        self._dtype = dtype
        part = copy.deepcopy(backbone)
        part.stages = nn.ModuleList(part.stages[:stages])
        part.output_stages = tuple(range(1, len(part.stages) + 1))
        part.eval().requires_grad_(False)
        fold_batch_norms(part, self._device)
        part.to(dtype, memory_format=torch.channels_last)  # type: ignore[call-overload]
        if self._device.type == "cpu":
            use_onednn(part)
        self._part = part

    @contextlib.contextmanager
    def used_by(self, backbone: Backbone) -> Iterator[None]:
        """Inside, the backbone takes the maps of its first stages from here."""
        backbone.frozen_maps = self._maps
        try:
            yield
        finally:
            backbone.frozen_maps = None

    @torch.no_grad()
    def _maps(self, images: Tensor) -> list[Tensor]:
        """images: (B, 3, H, W) -> the map of each stage, without gradient."""
        with torch.autocast(self._device.type, enabled=False):
            images = images.to(self._dtype).contiguous(memory_format=torch.channels_last)
            if self._device.type != "cpu":
                return list(self._part(images))
            maps_of_images = [self._part(image) for image in images.split(1)]
            return [torch.cat(maps) for maps in zip(*maps_of_images, strict=True)]


def _numbers_on_their_way(numbers: Mapping[str, Tensor]) -> Callable[[], dict[str, float]]:
    """A function that gives the numbers of an update by name. It waits for a GPU to finish it, but none after it."""
    values = torch.stack([value.detach() for value in numbers.values()])
    arriving = values.to("cpu", non_blocking=True)
    done = torch.cuda.Event() if values.device.type == "cuda" else None
    if done is not None:
        done.record()

    def read() -> dict[str, float]:
        if done is not None:
            done.synchronize()
        return dict(zip(numbers, arriving.tolist(), strict=True))

    return read


@dataclass(frozen=True)
class Progress:
    """An update of the weights, or the end of a step."""

    done: int  # number of steps done
    loss: float | None = None  # of an update; None at the end of a step
    scores: Validation | None = None  # of a validation at the end of the step


class Trainer:
    """A training that can be interrupted at any time and resumed from its last checkpoint.

    Writes checkpoint.pt, weights.safetensors, loss.csv, validation.csv and curves.png into the output folder.

    Attributes:
        job: model, drives and settings.
        trained: all modules that are trained: the model and the auxiliary heads.
        optimizer: of their parameters.
        done: the number of steps done.
        maker: makes the batches.
        waited_s: time for which the training had to wait for batches, seconds.
    """

    def __init__(self, job: TrainingJob, *, resume: bool = False) -> None:
        """Prepares model and optimizer. Raises WeightsError if the checkpoint to resume from is missing or wrong,
        and InputError if it has more steps than the training."""
        self.job = job
        job.model.backbone.freeze(job.config.frozen_stages)
        self._losses = FrameLosses(job.model, job.config)
        self.trained = nn.ModuleDict({"model": job.model, **self._losses.auxiliary_heads}).to(job.device)
        self.optimizer = make_optimizer(self.trained, job.model.backbone, job.config.optimizer)
        self._average: dict[str, Tensor] | None = None
        if job.config.optimizer.average > 0:
            self._average = {key: value.detach().clone() for key, value in job.model.state_dict().items()}
        self.done, self.waited_s = 0, 0.0
        self._missing = set[str]()  # images of the clips
        if resume:
            self.done = load_checkpoint(job.out / CHECKPOINT, self.trained, self.optimizer, self._average)
            if self.done > job.config.steps:
                limit = f"at most `steps={job.config.steps}` (`--steps {job.config.steps}`)"
                problem = f"has done {self.done} steps already (expected {limit})"
                raise InputError(f"{job.out}: {problem}")
        choose_training_kernels(job.model, job.device)
        taught = job.config.distillation_loss
        self._teacher = Teacher(job.model, taught, job.device) if taught.active else None
        kept_bytes = int(job.config.kept_share * free_memory() / (job.loaders * trainings_here()))  # of each loader
        self.maker = BatchMaker(
            job.drives, job.model.config, job.config.clips, job.config.augmentation, job.seed, job.group.rank,
            with_gap=job.model.config.trains_with_gaps, plain=self._teacher is not None and not taught.feature_weight,
            in_bytes=job.device.type == "cuda", memory=FrameMemory(kept_bytes),
        )  # fmt: skip
        self._frozen: FrozenStages | None = None
        if frozen := job.model.backbone.frozen_stages:
            dtype = torch.bfloat16 if computes_in_bfloat16(job.device) else torch.float32
            self._frozen = FrozenStages(job.model.backbone, frozen, dtype)
        if job.group.leads:
            events = event_writer(job.out / "tensorboard", self.done) if job.log else None
            self._loss_curve = LearningCurve(job.out / "loss.csv", self.done, "training", events)
            self._validation_curve = LearningCurve(job.out / "validation.csv", self.done, "validation", events)

    def run(self) -> Iterator[Progress]:
        """Run the remaining steps: yield after each update of the weights, and once more at the end of each step.

        Leaves the model in evaluation mode. To end early, leave the loop at the end of a step, after `save_checkpoint`.
        Raises BevcliError if a loss is not finite.
        """
        try:
            yield from self._run()
        finally:
            if self._missing:
                count, texts = counted(len(self._missing), "images"), "; ".join(sorted(self._missing))
                self._warn(f"{count} could not be read, and were black in training: {texts}")

    @staticmethod
    def _warn(text: str) -> None:
        logging.getLogger("bevcli").warning("warning: %s", one_line(text))

    def _run(self) -> Iterator[Progress]:
        job, config = self.job, self.job.config
        remaining, gpu = range(self.done, config.steps), job.device.type == "cuda"
        turns = product(remaining, range(config.clips.in_turn))
        loaded = loaded_batches(self.maker, turns, job.loaders, pin=gpu)
        with contextlib.closing(loaded) as batches, rounded_products("cuda", enabled=gpu):
            for _ in remaining:
                rows = []
                for row in self._step(islice(self._timed(batches), config.clips.in_turn)):
                    rows.append(row)
                    yield Progress(self.done, row["loss"])
                job.group.average_statistics(self.trained)
                trim_memory()
                self.done += 1
                yield Progress(self.done, scores=self._end_of_step(rows))
        job.model.eval()

    def _end_of_step(self, rows: Sequence[Mapping[str, float]]) -> Validation | None:
        """Write what belongs to the end of a step. rows: the numbers of its updates. Returns scores if it is time."""
        job, config = self.job, self.job.config
        last, scores = self.done == config.steps, None
        if job.group.leads:
            means = {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}
            norm = means.pop("gradient norm")
            rate = config.optimizer.learning_rate_at(self.done - 1, config.steps)
            self._loss_curve.add(self.done, means | {"learning rate": rate, "gradient norm": norm})
            if self.done % config.evaluate_every == 0 or last:
                scores = self._validate()
            if self.done % config.checkpoint_every == 0 or last:
                self.save_checkpoint()
        return scores

    def save_checkpoint(self) -> None:
        """Write the state after the steps done, in the leader."""
        if self.job.group.leads:
            path = self.job.out / CHECKPOINT
            save_checkpoint(path, self.done, self.trained, self.optimizer, self._average)

    def _timed(self, batches: Iterator[Batch]) -> Iterator[Batch]:
        """The same batches, with the time spent waiting for them added to `waited_s`."""
        for _ in repeat(None):
            begun = time.perf_counter()
            batch = next(batches, None)
            self.waited_s += time.perf_counter() - begun
            if batch is None:
                return
            if batch.missing and not self._missing:
                self._warn(f"{batch.missing[0]}: black in training; all of these are counted at the end")
            self._missing.update(batch.missing)
            yield batch

    def _step(self, batches: Iterable[Batch]) -> Iterator[dict[str, float]]:
        """One step, with an update of the weights for each frame trained on. Yields the numbers of each."""
        job, config = self.job, self.job.config
        for group in self.optimizer.param_groups:
            group["lr"] = config.optimizer.learning_rate_at(self.done, config.steps) * group["share"]
        gpus = [job.device] if job.device.type == "cuda" else []
        frozen = contextlib.nullcontext() if self._frozen is None else self._frozen.used_by(job.model.backbone)
        with torch.random.fork_rng(gpus), self._losses.watching(job.model), frozen:
            seeds = np.random.SeedSequence([job.seed, self.done, job.group.rank])
            torch.manual_seed(int(seeds.generate_state(1)[0]))  # for dropout
            uploaded = (batch.to(job.device).normalised(job.model.config.image) for batch in batches)
            learned = alternated(map(self._clip_losses, uploaded))
            for read_numbers in delayed(map(self._update, learned), 1 if gpus else 0):
                row = read_numbers()
                if not math.isfinite(row["loss"]):
                    raise BevcliError(
                        f"step {self.done + 1}: the loss is {row['loss']}; lower the learning rate, and `resume` "
                        f"(`--resume`) from the last checkpoint in {job.out}"
                    )
                yield row

    def _clip_losses(self, batch: Batch) -> Iterator[dict[str, Tensor]]:
        """The losses of each frame to train on, lazily: the model may be updated in between."""
        job, config = self.job, self.job.config
        random = config.augmentation.randomisation, job.model.config.image, torch.default_generator
        batch = replace(
            batch, inputs=tuple(replace(step, images=randomised(step.images, *random)) for step in batch.inputs)
        )
        outputs = forward_clip(
            job.model, batch, learn_all=config.clips.learn == "all", freeze_batch_norm=config.freeze_batch_norm
        )
        learned = len(batch.targets)
        lessons: Iterator[Lesson | None] = repeat(None)
        if self._teacher is not None:
            shown = batch if batch.plain is None else batch.plain
            lessons = islice(self._teacher.lessons(shown), len(batch.inputs) - learned, None)
        for inputs, targets in zip(batch.inputs[-learned:], batch.targets, strict=True):
            with torch.autocast(job.device.type, torch.bfloat16, enabled=computes_in_bfloat16(job.device)):
                output, taught = next(outputs), next(lessons)
            yield self._losses(inputs, output, targets, taught)

    def _update(self, losses: dict[str, Tensor]) -> Callable[[], dict[str, float]]:
        """One update of the weights. Returns a function that gives its numbers."""
        total = torch.stack(list(losses.values())).sum()
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        self.job.group.average_gradients(self.trained)
        norm = nn.utils.clip_grad_norm_(self.trained.parameters(), self.job.config.optimizer.max_gradient_norm)
        self.optimizer.step()
        if self._average is not None:
            update_average(self._average, self.job.model.state_dict(), self.job.config.optimizer.average)
        return _numbers_on_their_way({"loss": total, **losses, "gradient norm": norm})

    def averaged_model(self) -> Network:
        """A copy of the model, with the running mean of its weights where `optimizer.average` asks for it."""
        model = copy.deepcopy(self.job.model)
        if self._average is not None:
            model.load_state_dict(self._average)
        return model

    def _validate(self) -> Validation:
        job = self.job
        options = StepOptions(temporal=job.config.clips.frames > 1)
        # A copy, because a Runner puts timing hooks on its model and switches it to evaluation mode.
        model = self.averaged_model()
        if job.device.type == "cuda":
            model.step = torch.autocast("cuda", torch.bfloat16)(model.step)  # type: ignore[method-assign]
        runner = Runner(model, job.device, options)
        scores = score_drives(runner, job.held_out if len(job.held_out) else job.drives)
        self._validation_curve.add(self.done, scores.row())
        dtype = torch.float16 if job.config.weights_dtype == "float16" else torch.float32
        save_weights(job.out / WEIGHTS, model, dtype)
        draw_learning_curves(self._loss_curve, self._validation_curve, job.out / "curves.png")
        return scores


def delayed(items: Iterable[T], by: int) -> Iterator[T]:
    """The items, each when so many later ones have been made."""
    waiting = deque[T]()
    for item in items:
        waiting.append(item)
        if len(waiting) > by:
            yield waiting.popleft()
    yield from waiting


def alternated(iterators: Iterable[Iterator[T]]) -> Iterator[T]:
    """The first item of each iterator, then the second of each, and so on until all are exhausted."""
    remaining: Iterable[Iterator[T]] = iterators
    while remaining:
        going = []
        for iterator in remaining:
            for item in islice(iterator, 1):
                yield item
                going.append(iterator)
        remaining = going


def computes_in_bfloat16(device: torch.device) -> bool:
    """True where the device has bfloat16 instructions, so that mixed precision is faster."""
    # PyTorch 2.6, the lowest version, has no public name for it.
    return device.type == "cuda" or torch.cpu._is_avx512_bf16_supported()


def save_checkpoint(
    path: Path,
    step: int,
    trained: nn.Module,
    optimizer: torch.optim.AdamW,
    average: Mapping[str, Tensor] | None = None,
) -> None:
    """Writes the state after `step` steps, to resume from. Random numbers are drawn from seed and step, not stored.

    trained: the model and its auxiliary heads. average: the running average of the model's weights, None without one.
    """
    contents = {"format": FORMAT, "step": step, "model": trained.state_dict(), "optimizer": optimizer.state_dict()}
    if average is not None:
        contents["average"] = dict(average)
    with whole_file(path) as unfinished:
        save(contents, unfinished)


def load_checkpoint(
    path: Path, trained: nn.Module, optimizer: torch.optim.AdamW, average: dict[str, Tensor] | None = None
) -> int:
    """Restores model, auxiliary heads, optimizer and, in place, the running average of the weights.

    Returns the number of steps done. Raises WeightsError.
    """
    if not path.exists():
        raise WeightsError(f"{path}: no checkpoint to resume from; leave out `resume` (`--resume`) to start a training")
    file = read_pth(path)
    if file.left_out:
        raise WeightsError(f"{path}: is not a checkpoint of this model: it holds objects ({file.left_out[0]:.100})")
    try:
        contents = file.contents
        if contents["format"] != FORMAT:
            raise WeightsError(f'{path}: "format" must be "{FORMAT}", found {contents["format"]!r:.60}')
        trained.load_state_dict(contents["model"])
        settings = [dict(group) for group in optimizer.param_groups]
        optimizer.load_state_dict(contents["optimizer"])
        for group, setting in zip(optimizer.param_groups, settings, strict=True):
            group.update(setting)  # of this training, not of the file
        for key, value in {} if average is None else average.items():
            value.copy_(contents["average"][key])
        _check_numbers(optimizer, [*trained.state_dict().values(), *(average or {}).values()])
        if type(contents["step"]) is not int or contents["step"] < 0:
            raise ValueError(f"its step is {contents['step']!r:.40} (expected an integer, 0 or more)")
        return contents["step"]
    except _DAMAGE as error:
        reason = " ".join(line.strip() for line in str(error).split("\n")[:2])
        raise WeightsError(f"{path}: is not a checkpoint of this model: {reason}") from error


def _check_numbers(optimizer: torch.optim.AdamW, tensors: list[Tensor]) -> None:
    """Raises ValueError for what PyTorch takes: moments of a wrong shape or sign, NaN in them or in `tensors`."""
    for parameter, moments in optimizer.state.items():
        first, second, step = (moments[name] for name in ("exp_avg", "exp_avg_sq", "step"))
        if not first.shape == second.shape == parameter.shape or step.shape or min(step, second.min()) < 0:
            raise ValueError("the optimizer's moments do not fit the weights")
        tensors = [*tensors, first, second, step]
    if not all(torch.isfinite(tensor).all() for tensor in tensors):
        raise ValueError("some of its numbers are NaN or infinite")


def save_weights(path: Path, model: Network, dtype: torch.dtype) -> None:
    """Writes the model's weights as .safetensors, for `bevcli run --weights`, with the frame and rigs they expect."""
    state = {
        key: (tensor.to(dtype) if tensor.is_floating_point() else tensor).contiguous().cpu()
        for key, tensor in model.state_dict().items()
    }
    write_whole(path, safetensors.torch.save(state, weights_facts(model.config)))


def train(model: str | Path, *, device: str = "auto", **options: Any) -> Path:
    """Train a model as `bevcli train` does; return the file of its weights.

        weights = bevcli.train("my.toml", data=["drives/a", "drives/b"], out="runs/mine", steps=2000)
        model = bevcli.load_model("my.toml", weights=weights)

    `training` gives the loop, to follow it or to end it early, and the notes on the drives and on what is loaded of
    earlier weights.

    Args:
        model: a model name or a FILE.toml, whose training table holds the settings.
        device: "auto", "cpu", "cuda" and so on.
        options: those of `TrainOptions` (`out`, `steps`, `weights`, `resume`, …) and of `DriveOptions` (`data`,
            `rendered`, `split`, `class_map`).

    Raises:
        InputError: a drive or a setting is wrong.
        WeightsError: the weights to start from cannot be read or do not fit.
        OutputError: the folder holds another training, is in use, or cannot be written.
    """
    train_options, drives, unknown = spread(options, TrainOptions, DriveOptions)
    refuse(unknown, "train", TrainOptions, DriveOptions)
    with training(str(model), drives, train_options, device) as trainer:
        for _ in trainer.run():
            pass
    return trainer.job.out / WEIGHTS


@contextlib.contextmanager
def training(
    model: str, drives: DriveOptions, options: TrainOptions = TrainOptions(), device: str = "auto"
) -> Iterator[Trainer]:
    """A training that is ready to run, with its output folder locked.

        with training("my.toml", DriveOptions(data=(Path("drives/a"),))) as trainer:
            for progress in trainer.run():
                print(progress)

    Raises BevcliError as `train`.
    """
    job = prepare_training(model, choose_device(device), drives, options)
    with job.lock:
        yield Trainer(job, resume=options.resume)
    job.group.leave()


def validate(model: Model | str | Path | None = None, *, temporal: bool = True, **options: Any) -> Validation:
    """Score a model on drives with ground truth, all drives together, as `bevcli validate` does.

        scores = bevcli.validate("demo", data="samples/street")
        print(scores.table())

    Args:
        model: a `Model`, or what `load_model` takes. None: "demo" if bevcli rendered all drives, else "photographs".
        temporal: use the frames before (and after).
        options: those of `DriveOptions` (`data`, `rendered`, …) and `ValidationOptions` (`rig`, `max_range`,
            `tracking`, `each`); and of `ModelOptions` (`weights`, `device`, `engine`, …), where `model` is no `Model`.

    Raises InputError for a drive that cannot be read or has no ground truth, and what `load_model` raises.
    """
    of_model = () if isinstance(model, Model) else (ModelOptions,)
    drives, settings, *model_options, unknown = spread(options, DriveOptions, ValidationOptions, *of_model)
    refuse(unknown, "validate", DriveOptions, ValidationOptions, *of_model)
    if isinstance(model, Model):
        loaded, why = model, tuple[str, ...]()
    else:
        model_choice, why = choose_model(replace(model_options[0], model=model), paths_to_score(drives))
        loaded = load_model(options=model_choice)
    name = loaded.name if model is None or isinstance(model, Model) else str(model)
    scored: Drives = deque[Any](drives_to_score(loaded.config, name, drives, settings), maxlen=1).pop()
    notes = (*why, *check_scored_drives(drives, scored, loaded.config))
    if loaded.needs_export:
        loaded = loaded.in_engine(scored.open(0).rig, scored.open(0))
    runner = loaded.runner(StepOptions(track=settings.tracking, temporal=temporal))
    return replace(score_drives(runner, scored, settings.max_range, each_drive=settings.each), notes=notes)


def drives_to_score(
    config: ModelConfig, name: str, drive_options: DriveOptions, options: ValidationOptions
) -> Iterator[tuple[int, int] | Drives]:
    """The drives of a validation at the end; before, the steps that `odometry` measures, see `open_steps`.

    name: of the model, or its file.
    """
    rig: CameraRig | RigDistribution | None = None
    if options.rig == "random":
        rig = replace(load_table(name, TRAINING, TrainingConfig).rigs, random_share=1.0)
    elif options.rig is not None:
        rig = rig_for_rendering(options.rig, None)
    drives = scored_drives(drive_options, config, rig)
    if options.odometry:
        yield from drives.measure_motion()
    yield drives


def paths_to_score(options: DriveOptions) -> tuple[Path, ...] | None:
    """The drives of a validation, for `choose_model`: None for rendered ones. Raises InputError as `read_split`."""
    if options.rendered is not None:
        return None
    return options.data if options.split is None else read_split(options.split).validate


def has_ground_truth(drives: Drives) -> bool:
    """True if a frame of one of the drives has ground truth."""
    return any(
        drive.ground_truth_frame(index).ground_truth is not None
        for drive in map(drives.open, range(len(drives)))
        for index in range(len(drive.stamps))
    )
