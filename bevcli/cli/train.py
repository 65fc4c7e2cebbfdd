"""`bevcli train`: train a model on sequences with ground truth or on rendered drives."""

from typing import Annotated

import typer

from bevcli.cli.bridge import INPUT_OR_NAME, OldArgument, Part
from bevcli.inference.options import ModelOptions, complete_model
from bevcli.printing import say
from bevcli.synth.options import DriveOptions
from bevcli.training.options import TrainOptions

PANEL = "Train"


def train(
    model: Annotated[
        str,
        typer.Option(
            autocompletion=complete_model,
            metavar="NAME|FILE",
            help="A model name or a FILE.toml; required. Its training table holds the settings.",
            rich_help_panel="Model",
            show_default=False,
        ),
        OldArgument,
        INPUT_OR_NAME,
    ] = "",
    *,
    model_options: Annotated[ModelOptions, Part(only=("device",))],
    drives: Annotated[DriveOptions, Part(only=("data", "rendered", "class_map"))],
    options: TrainOptions,
) -> None:
    """Train a model; write its weights, checkpoints and learning curves.

    The last drives are held out for evaluation (--held-out). Ctrl-C and SIGTERM write a checkpoint after the current
    step; --resume continues from it, on a CPU with the same result. Run weights.safetensors with
    `bevcli run --weights`.

    `torchrun --nproc-per-node N -m bevcli train …` trains with N processes, one for each GPU or CPU core.
    """
    import torch

    from bevcli.cli.progress import Progress
    from bevcli.cli.stop_signals import StopSignals
    from bevcli.inference.load import choose_device
    from bevcli.training.job import leave_process_group, prepare_training
    from bevcli.training.trainer import Trainer

    if not model:
        raise typer.BadParameter("is missing (expected a model name or a FILE.toml)", param_hint="--model")
    torch.manual_seed(options.seed)
    job = prepare_training(model, choose_device(model_options.device), drives, options)
    trainer = Trainer(job, resume=options.resume)
    if not job.group.leads:
        with StopSignals("step") as signals:
            trainer.run(stop=signals.received)
        leave_process_group(job.group)
        return
    if job.warm_start is not None:
        say(job.warm_start.table())
    with Progress(job.config.steps - trainer.done, "steps") as progress:
        progress.message(
            f"drives: {len(job.drives)} to train on, {len(job.held_out)} to evaluate on; output: {job.out}"
        )
        with StopSignals("step") as signals:
            trainer.run(
                progress.advance, lambda step, scores: progress.message(f"step {step}: {scores}"), signals.received
            )
        if trainer.done < job.config.steps:
            progress.message(f"stopped after step {trainer.done}: continue with --resume --out {job.out}")
            raise typer.Exit(signals.exit_code)
    leave_process_group(job.group)
