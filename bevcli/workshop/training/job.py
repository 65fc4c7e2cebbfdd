"""Inputs of a training: the [training] table of a model file, a model, drives, an output folder and its processes."""

import contextlib
import difflib
import json
import math
import os
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from bevcli.config import TRAINING, load_config, load_table, settings_of_table
from bevcli.errors import ConfigError, InputError, OutputError
from bevcli.inference.load import weights_file
from bevcli.model.network import Network, build_network
from bevcli.parsing.documents import Count, CountOrNone, Positive, ShareBelowOne, read_json
from bevcli.runs.state import OWN, folder_lock
from bevcli.workshop.synth import DriveOptions
from bevcli.workshop.synth.drives import Drives, Split, training_drives, write_split
from bevcli.workshop.synth.rig import RigDistribution
from bevcli.workshop.training import Log, TrainOptions
from bevcli.workshop.training.augmentation import AugmentationConfig
from bevcli.workshop.training.frame_losses import LossConfigs
from bevcli.workshop.training.samples import ClipConfig
from bevcli.workshop.training.validation import check_training_drives, require_tensorboard
from bevcli.workshop.training.warm_start import WarmStart, start_backbone, warm_start
from bevcli.writing import write_whole


@dataclass(frozen=True)
class ProcessGroup:
    """This process among those that train together."""

    rank: int = 0  # of this process, 0 to size - 1; the leader has rank 0
    size: int = 1  # the number of processes, 1 without torchrun

    @property
    def leads(self) -> bool:
        """True in the leader, which writes files and prints."""
        return self.rank == 0

    def average_gradients(self, trained: nn.Module) -> None:
        """Replaces each gradient by its mean over the processes; a missing gradient counts as zero."""
        if self.size > 1:
            learned = [parameter for parameter in trained.parameters() if parameter.requires_grad]
            for parameter in learned:
                if parameter.grad is None:
                    parameter.grad = torch.zeros_like(parameter)
            self._average([parameter.grad for parameter in learned if parameter.grad is not None])

    def average_statistics(self, trained: nn.Module) -> None:
        """Replaces the running statistics of batch norms (all float buffers) by their mean over the processes."""
        if self.size > 1:
            self._average([buffer for buffer in trained.buffers() if buffer.is_floating_point()])

    def _average(self, tensors: list[Tensor]) -> None:
        flat = torch.cat([tensor.flatten() for tensor in tensors])
        torch.distributed.all_reduce(flat)
        flat /= self.size
        for tensor, mean in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(mean.view_as(tensor))

    def leave(self) -> None:
        """End the communication with the other processes."""
        if self.size > 1:
            torch.distributed.destroy_process_group()


def join_process_group(device: torch.device) -> ProcessGroup:
    """Joins the group in which torchrun started this process; a group of one without torchrun.

    On GPUs each process takes the one of its local rank.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return ProcessGroup()
    if device.type == "cuda":
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    torch.distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return ProcessGroup(torch.distributed.get_rank(), torch.distributed.get_world_size())


@dataclass(frozen=True)
class OptimizerConfig:
    """The [training.optimizer] table."""

    learning_rate: Positive = 2e-4  # the peak learning rate
    backbone_share: float = 0.1  # learning rate of the image backbone relative to the rest; 1 for an untrained backbone
    weight_decay: float = 0.01  # of AdamW
    warm_up_steps: CountOrNone = 500  # steps in which the rate rises linearly
    warm_up_start: float = 1 / 3  # relative rate at step 0
    final_share: float = 1e-3  # relative rate at the end of the cosine decay
    max_gradient_norm: Positive = 35.0  # gradients are clipped to this L2 norm
    # decay an update of a running average of the weights, which is scored and released; 0: none
    average: ShareBelowOne = 0.0

    def learning_rate_at(self, step: int, steps: int) -> float:
        """The learning rate of a step (0 to steps - 1)."""
        cosine = (1 + math.cos(math.pi * step / steps)) / 2
        share = self.final_share + (1 - self.final_share) * cosine
        if step < self.warm_up_steps:
            share *= self.warm_up_start + (1 - self.warm_up_start) * step / self.warm_up_steps
        return self.learning_rate * share


CHECKPOINT = "checkpoint.pt"  # in the output folder


@dataclass(frozen=True)
class TrainingConfig(LossConfigs):
    """The [training] table of a model file."""

    steps: Count = 10_000  # number of steps. A step draws one batch of clips, or `clips.in_turn` batches
    held_out: CountOrNone = 2  # the last drives, so many, are for evaluation only; 0 evaluates on the training drives
    evaluate_every: Count = 1000  # steps between evaluations
    checkpoint_every: Count = 250  # steps between checkpoints
    freeze_batch_norm: bool = False  # keep the running statistics of batch norms, for fine-tuning
    frozen_stages: CountOrNone = 0  # of the backbone, from the stem on, with their batch norms; 0 trains all of it
    # processes that make batches ahead, 1 for a thread; 0 is 1 on a CPU, with a GPU all cores but two
    loaders: CountOrNone = 0
    # share of the free memory for decoded images, of all loaders together; 0 keeps none
    kept_share: ShareBelowOne = 0.25
    weights_dtype: Literal["float32", "float16"] = "float32"  # data type of weights.safetensors
    clips: ClipConfig = field(default_factory=ClipConfig)  # how clips are drawn
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)  # image augmentation
    rigs: RigDistribution = field(default_factory=RigDistribution)  # the rigs of rendered drives
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)  # AdamW and the learning rate schedule


CORES_OF_TRAINING = 2  # that make no batches, with a GPU


@dataclass(frozen=True)
class TrainingJob:
    """Everything that a `Trainer` needs."""

    model: Network  # is trained in place
    config: TrainingConfig  # the [training] table
    drives: Drives  # to train on
    held_out: Drives  # to evaluate on; empty to evaluate on `drives`
    out: Path  # the output folder, which exists
    device: torch.device  # device to train on
    seed: int = 0  # determines all random draws, together with the step and the rank of the process
    group: ProcessGroup = field(default_factory=ProcessGroup)  # the processes that train together
    notes: tuple[str, ...] = ()  # about the drives, for the user
    log: Log | None = None  # where the learning curves are written, besides the CSV files; None for nowhere
    warm_starts: tuple[WarmStart, ...] = ()  # what it starts from; empty for random weights, or if resumed
    lock: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)  # of the folder, in the leader

    @property
    def loaders(self) -> int:
        """The number of processes that make batches, 1 for a thread of this process."""
        if self.config.loaders or self.device.type == "cpu":
            return self.config.loaders or 1
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        return max(1, cores // trainings_here() - CORES_OF_TRAINING)

    def changed_settings(self) -> tuple[str, ...]:
        """A note where the settings differ from those of the training so far in this folder; stores them."""
        file, old = self.out / OWN / "training.json", {}
        settings = {"seed": self.seed, "steps": self.config.steps, **asdict(self.config.optimizer)}
        if (self.out / CHECKPOINT).exists() and file.exists():  # else a new training, or one of an older version
            old = read_json(file)
        write_whole(file, json.dumps(settings).encode(), parents=True)
        changed = [f"{name} {new} (before {old[name]})" for name, new in settings.items() if old.get(name, new) != new]
        return (f"the training goes on with other settings: {', '.join(changed)}",) if changed else ()


def trainings_here() -> int:
    """Processes on this machine that train together."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", "1"))


def free_memory(root: Path = Path("/")) -> int:
    """Bytes that a process may still take, within the limit of a Linux container; 0 where that is not known."""
    groups = root / "sys/fs/cgroup"
    try:
        free = [1024 * _number(root / "proc/meminfo", r"MemAvailable:\s+(\d+)")]
    except (OSError, ValueError):
        return 0
    for limit, used, cache in (
        ("memory.max", "memory.current", "memory.stat"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat"),
    ):
        with contextlib.suppress(OSError, ValueError):  # no such limit
            left = _number(groups / limit) - _number(groups / used)
            free.append(left + _number(groups / cache, r"\binactive_file (\d+)"))
    return max(0, min(free))


def _number(path: Path, pattern: str = r"^(\d+)$") -> int:
    """The number in a file of the system. Raises OSError, and ValueError where there is none."""
    match = re.search(pattern, path.read_text(encoding="utf-8"))
    if match is None:
        raise ValueError
    return int(match[1])


def prepare_training(
    model_name_or_file: str, device: torch.device, data: DriveOptions, options: TrainOptions = TrainOptions()
) -> TrainingJob:
    """A training job, ready for `Trainer`. Joins the other processes if torchrun started several.

    Seeds PyTorch's global generator, from which initial weights are drawn.
    data: the drives; rendered ones are kept in the output folder.

    Raises BevcliError where a file, the choice of drives, or the output folder is wrong; nothing is written then.
    """
    model_config = load_config(model_name_or_file)
    config = load_table(model_name_or_file, TRAINING, TrainingConfig)
    held_out = config.held_out if options.held_out is None else options.held_out
    config = with_changes(replace(config, steps=options.steps or config.steps, held_out=held_out), options.changes)
    model_config.check_training(config.clips.frames)
    out = options.out or Path("runs") / f"train-{model_config.name}"
    check_folder(out, resume=options.resume)
    if options.log is not None:
        require_tensorboard()
    if data.split is not None and options.held_out is not None:
        raise InputError(
            f"{data.split}: states the drives to score on: remove `held_out` (`--held-out`), or `split` (`--split`)"
        )
    rigs = config.rigs if max(config.rigs.random_share, config.rigs.moving_share, config.rigs.varied_share) else None
    drives, evaluated = training_drives(data, config.held_out, out / "drives", model_config, rigs)
    scored_apart = None if data.split is None and config.held_out == 0 else evaluated
    notes = check_training_drives(data, drives, scored_apart, config.clips, model_config)
    if data.rendered is not None and not (out / "drives").exists():
        notes += ("each drive is rendered when it is first drawn, which takes seconds: the first step waits for some",)
    if config.freeze_batch_norm and not (options.weights or options.backbone_weights or options.resume):
        notes += (
            "the model starts from random weights, but its file keeps the statistics of batch norms: pass "
            '`weights` (`--weights`) or `changes={"freeze_batch_norm": "false"}` (`--set freeze_batch_norm=false`)',
        )
    torch.manual_seed(options.seed)
    model, started = build_network(model_config), []
    if options.weights is not None and not options.resume:
        file, another = weights_file(options.weights), options.backbone_weights is not None
        started += [warm_start(file, model, model_name_or_file, drives, another_backbone=another)]
    if options.backbone_weights is not None and not options.resume:
        backbone, about = start_backbone(weights_file(options.backbone_weights), model, model_name_or_file)
        started, notes = [*started, backbone], (*notes, *about)
    group, lock = join_process_group(device), contextlib.ExitStack()
    if group.leads and not (options.resume and not out.exists()):
        lock.enter_context(folder_lock(out))
        check_folder(out, resume=options.resume)  # again: another training may have been faster
    if group.leads and scored_apart is not None and data.rendered is None:
        write_split(out / "split.toml", Split(drives.folders, scored_apart.folders))
    rest = options.seed, group, notes, options.log, tuple(started), lock
    return TrainingJob(model, config, drives, evaluated, out, device, *rest)


def check_folder(out: Path, *, resume: bool) -> None:
    """Raises OutputError if an output folder holds a training that is not to be resumed."""
    if (out / CHECKPOINT).exists() and not resume:
        raise OutputError(
            f"{out}: already holds a training; pass `resume=True` (`--resume`) to continue it, or `out` (`--out DIR`) "
            "for a new one"
        )


def with_changes(config: TrainingConfig, changes: Mapping[str, str]) -> TrainingConfig:
    """The settings with some of them changed.

    changes: values by key, such as {"optimizer.learning_rate": "1e-4"}, as in TOML; a text may lack its quotes.
    Raises ConfigError for an unknown key, which names the nearest, or a wrong value.
    """
    table: dict[str, Any] = asdict(config)
    keys = list(_keys(config))
    for key, text in changes.items():
        key = key.removeprefix(f"{TRAINING}.")
        if key not in keys:
            last = {name.rpartition(".")[2]: name for name in reversed(keys)}  # a key may lack its table
            similar = difflib.get_close_matches(key, keys, 1) or [
                last[name] for name in difflib.get_close_matches(key, last, 1)
            ]
            advice = f'did you mean "{similar[0]}"?' if similar else "the keys are in the table of docs/training.md"
            raise ConfigError(f'`changes` (`--set`): unknown key "{key:.100}"; {advice}')
        *tables, name = key.split(".")
        inner = table
        for name_of_table in tables:
            inner = inner[name_of_table]
        inner[name] = text
        with contextlib.suppress(tomllib.TOMLDecodeError, KeyError):  # a text may lack its quotes
            inner[name] = tomllib.loads(f"value = {text}")["value"]
    return settings_of_table({TRAINING: table}, TRAINING, TrainingConfig, "`changes` (`--set`)")


def _keys(config: Any, prefix: str = "") -> Iterator[str]:
    for name, value in vars(config).items():
        if is_dataclass(value):
            yield from _keys(value, f"{prefix}{name}.")
        else:
            yield prefix + name
