"""`bevcli train` trains a model; `bevcli validate` runs one on several drives and scores them together."""

import contextlib
import json
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

import bevcli
from bevcli.cli.bridge import Json, Part, model_option
from bevcli.cli.progress import Progress, last_of_steps
from bevcli.cli.stop_signals import StopSignals
from bevcli.errors import InputError
from bevcli.inference import ModelOptions, StepOptions
from bevcli.printing import counted, print_note, say
from bevcli.runs import RunOptions
from bevcli.workshop.synth import DriveOptions
from bevcli.workshop.training import ModelFileOptions, TrainOptions, ValidationOptions

if TYPE_CHECKING:
    from bevcli.inference.load import Model
    from bevcli.workshop.synth.drives import Drives
    from bevcli.workshop.training.trainer import Trainer


PANEL = {"train": "Train", "validate": "Score"}


def train(
    model: Annotated[
        str | None,
        model_option("A model name or a FILE.toml; required. Its training table holds the settings."),
    ] = None,
    *,
    model_options: Annotated[ModelOptions, Part(only=("device",))],
    drives: Annotated[DriveOptions, Part(only=("data", "rendered", "split", "class_map"))],
    file_options: ModelFileOptions,
    options: TrainOptions,
) -> None:
    """Train a model; write its weights, checkpoints and learning curves.

    A step is one update of the weights. If clips.learn is "all", it is one for each frame of clips.in_turn batches.

    The last drives are held out for evaluation (--held-out), or a file states them (--split). Ctrl-C and SIGTERM write
    a checkpoint after the current step; --resume continues from it, on a CPU with the same result. Run
    weights.safetensors with `bevcli run --weights`.

    `bevcli train --init my.toml --data DIR …` writes a model file for these drives; then train with `--model my.toml`.

    `torchrun --nproc-per-node N -m bevcli train …` trains with N processes, one for each GPU or CPU core.
    """
    from bevcli.workshop.training import model_file, trainer as work

    if file_options.init is not None:
        if model or options != TrainOptions():
            raise InputError("--init trains nothing: remove the model and the options of a training")
        device = work.choose_device(model_options.device)
        say(*model_file.write_model_file(file_options.init, drives, file_options.preset or "quick", device))
        return
    if file_options.preset is not None:
        raise InputError("--preset is for --init: remove it")
    if not model:
        raise typer.BadParameter("is missing (expected a model name or a FILE.toml)", param_hint="--model")
    with work.training(model, drives, options, model_options.device) as trainer:
        _run(trainer)


def _run(trainer: "Trainer") -> None:
    """Train; the leader of several processes prints. Raises typer.Exit in it after a stop."""
    job, first = trainer.job, trainer.done
    updates, steps = job.config.clips.updates, job.config.steps - first
    with contextlib.ExitStack() as stack:
        progress = None
        if job.group.leads:
            counts = f"{len(job.drives)} to train on, {len(job.held_out)} to evaluate on"
            say(f"{job.config.clips}; {counted(steps, 'steps')}; drives: {counts}; output: {job.out}", err=True)
            for note in (*job.notes, *job.changed_settings()):
                print_note(note)
            for start in job.warm_starts:
                say(start.table())
            progress = stack.enter_context(Progress(steps * updates, "updates"))
        signals = stack.enter_context(StopSignals("step"))
        for event in trainer.run():
            if progress is not None and event.loss is not None:
                progress.detail = f"step {event.done + 1}, loss {event.loss:.4g}"
                progress.advance()
            elif progress is not None:
                progress.reach((event.done - first) * updates)  # after a step of fewer updates
                if event.scores is not None:
                    progress.message(f"step {event.done}: {event.scores}")
            if event.loss is None and signals.received():
                trainer.save_checkpoint()
                break
        if progress is not None and trainer.done < job.config.steps:
            progress.message(f"stopped after step {trainer.done}: continue with --resume --out {job.out}")
            raise typer.Exit(signals.exit_code)


def validate(
    model: Annotated[
        str | None,
        model_option(
            "A model name, a FILE.toml or a FILE.onnx. Default: the model that WEIGHTS fit, else photographs, or "
            "demo where bevcli rendered all drives."
        ),
    ] = None,
    *,
    model_options: Annotated[ModelOptions, Part(only=("weights", "device", "engine", "precision", "calibrate_with"))],
    run_options: Annotated[RunOptions, Part(only=("temporal",))],
    drive_options: DriveOptions,
    options: ValidationOptions,
    as_json: Json = False,
) -> None:
    """Score a model on drives with ground truth, all drives together; hold its boxes against a detector without.

    Each drive is run as by `bevcli run` and scored as by `bevcli eval`, which scores the files of a run that is done.
    `bevcli train` never uses rendered drives with seeds of 1000000 and above: keep them for this.
    Where no drive has ground truth, the boxes are compared with what a detector sees in the images.
    """
    from bevcli.workshop.training import trainer as work, validation

    chosen, why = work.choose_model(replace(model_options, model=model), work.paths_to_score(drive_options))
    loaded = bevcli.load_model(options=chosen)
    drives = last_of_steps(work.drives_to_score(loaded.config, model or loaded.name, drive_options, options))
    notes = (*why, *validation.check_scored_drives(drive_options, drives, loaded.config))
    if loaded.needs_export:
        loaded = loaded.in_engine(drives.open(0).rig, drives.open(0))
        notes = (*notes, loaded.engine_note) if loaded.engine_note else notes
    total = work.count_frames(drives)
    if not work.has_ground_truth(drives):
        beside = work.FolderDrives(() if options.reference is None else (options.reference,), loaded.config)
        total += work.count_frames(beside)
        _estimate(loaded, [drives, beside], total, options, why, as_json=as_json, temporal=run_options.temporal)
        return
    if options.reference is not None:
        raise InputError("--reference is for drives without ground truth: remove it")
    with Progress(total, "frames", notes) as progress:
        runner = loaded.runner(StepOptions(track=options.tracking, temporal=run_options.temporal))
        frames = progress.over(validation.run_drives(runner, drives))
        scores = validation.score_drives(runner, drives, options.max_range, each_drive=options.each, frames=frames)
    say(json.dumps(scores.to_dict(), indent=1) if as_json else f"drives  {len(drives)}\n\n{scores.table()}")


def _estimate(
    model: "Model",
    drives: "list[Drives]",
    frames: int,
    options: ValidationOptions,
    why: tuple[str, ...],
    *,
    as_json: bool,
    temporal: bool,
) -> None:
    """Print the agreement of each drive with the witness; none of them has ground truth.

    drives: with those of a reference as the second item. frames: of all of them. why: notes on the model.
    """
    from bevcli.workshop.trust import agreement as held, estimate, faults

    for name, is_set in (("--max-range", options.max_range is not None), ("--tracking", options.tracking)):
        if is_set:
            raise InputError(f"{name}: needs ground truth, which no drive has: remove it")
    notes = (*why, "no drive has ground truth: the boxes are held against a detector in the images (docs/trust.md)")
    found = []
    with Progress(frames, "frames", notes) as progress:
        for drive in (some.open(index) for some in drives for index in range(len(some))):
            parts = list(progress.over(estimate.frames_of_model(model, drive, temporal=temporal)))
            found.append((drive.name, parts, replace(held.agreement(parts), findings=faults.find_faults(model, drive))))
    reference = None if options.reference is None else found.pop()[2]
    scores = [(name, score) for name, _, score in found]
    together = held.agreement([frame for _, parts, _ in found for frame in parts])
    if as_json:
        say(json.dumps(estimate.as_document(together, scores, reference), indent=1))
        return
    if len(scores) > 1:
        say(f"all drives\n{together.table(reference)}\n")
    say("\n\n".join(f"drive  {name}\n{score.table(reference)}" for name, score in scores))
