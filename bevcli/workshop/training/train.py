"""`train` and `validate` as functions with the options of the commands as keywords."""

import contextlib
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from bevcli.inference import ModelOptions, StepOptions
from bevcli.inference.load import Model, choose_device, choose_model, load_model
from bevcli.model.config import ModelConfig
from bevcli.options import refuse, spread
from bevcli.workshop.synth import DriveOptions
from bevcli.workshop.synth.drives import (
    Drives,
    FolderDrives as FolderDrives,
    count_frames as count_frames,
    read_split,
    scored_drives,
)
from bevcli.workshop.training import TrainOptions, ValidationOptions
from bevcli.workshop.training.job import prepare_training, rig_for_drives
from bevcli.workshop.training.trainer import WEIGHTS, Trainer
from bevcli.workshop.training.validation import Validation, check_scored_drives, validate as validate_runner


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


def validate(
    model: Model | str | Path | None = None,
    *,
    temporal: bool = True,
    **options: Any,
) -> Validation:
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
    return replace(validate_runner(runner, scored, settings.max_range, each_drive=settings.each), notes=notes)


def drives_to_score(
    config: ModelConfig,
    name: str,
    drive_options: DriveOptions,
    options: ValidationOptions,
) -> Iterator[tuple[int, int] | Drives]:
    """The drives of a validation at the end; before, the steps that `odometry` measures, see `open_steps`.

    name: of the model, or its file.
    """
    rig = None if options.rig is None else rig_for_drives(options.rig, name)
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
