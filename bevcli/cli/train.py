"""`bevcli train`: train a model on sequences with ground truth or on rendered drives."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from bevcli.cli.input_options import complete_model
from bevcli.cli.run_options import DeviceOption


def train(
    config: Annotated[
        str,
        typer.Argument(
            autocompletion=complete_model, help="A model name or a FILE.toml. Its training table holds the settings."
        ),
    ],
    data: Annotated[
        list[Path] | None,
        typer.Option(metavar="DIR", help="A sequence with ground truth (see bevcli convert). Repeatable."),
    ] = None,
    rendered: Annotated[
        str | None,
        typer.Option(
            metavar="SEEDS", help="Train on rendered drives with these seeds instead: A:B (B excluded), or A,B,C."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for weights, checkpoint, learning curves and rendered drives. Default: runs/train-MODEL.",
            show_default=False,
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Resume from the checkpoint in the output folder.")] = False,
    weights: Annotated[
        Path | None, typer.Option(help="Start from these weights (fine-tuning) instead of random ones.")
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(min=1, help="Number of steps. Default: as in the training table.", show_default=False),
    ] = None,
    held_out: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Hold out the last N drives for evaluation; 0 evaluates on the training drives. Default: as in the "
            "training table.",
            metavar="N",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 0,
    device: DeviceOption = "auto",
) -> None:
    """Train a model; write its weights, checkpoints and learning curves.

    The last drives are held out for evaluation (--held-out). Ctrl-C and SIGTERM write a checkpoint after the current
    step; --resume continues from it, on a CPU with the same result. Run weights.safetensors with
    `bevcli run --weights`.

    `torchrun --nproc-per-node N -m bevcli train …` trains with N processes, one for each GPU or CPU core.
    """
    import torch

    from bevcli.cli.progress import Progress
    from bevcli.pipeline.model_loading import choose_device
    from bevcli.training.drives import parse_seeds
    from bevcli.training.job import prepare_training
    from bevcli.training.process_group import leave_process_group
    from bevcli.training.trainer import Trainer

    torch.manual_seed(seed)
    job = prepare_training(
        config,
        choose_device(device),
        folders=data or (),
        rendered_seeds=None if rendered is None else parse_seeds(rendered),
        out=out,
        weights=weights,
        steps=steps,
        held_out=held_out,
        seed=seed,
        resume=resume,
    )
    trainer = Trainer(job, resume=resume)
    if job.group.leads:
        with Progress(job.config.steps - trainer.done, "steps") as progress:
            progress.message(
                f"drives: {len(job.drives)} to train on, {len(job.held_out)} to evaluate on; output: {job.out}"
            )
            with StopRequest() as request:
                trainer.run(progress.advance, lambda step, scores: progress.message(f"step {step}: {scores}"), request)
            if trainer.done < job.config.steps:
                progress.message(f"stopped after step {trainer.done}: continue with --resume --out {job.out}")
        if trainer.done < job.config.steps:
            raise typer.Exit(request.exit_code)
    else:
        with StopRequest() as request:
            trainer.run(stop=request)
    leave_process_group(job.group)


class StopRequest:
    """While it is entered, Ctrl-C and SIGTERM only note that the training should stop; a second Ctrl-C ends it at once.

    Calling it tells whether it should stop.

    Attributes:
        exit_code: of the process, 128 + the number of the signal.
    """

    def __init__(self) -> None:
        self.exit_code = 0
        self._earlier: dict[int, Any] = {}

    def __enter__(self) -> StopRequest:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._earlier[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._earlier.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        return self.exit_code != 0

    def _note(self, number: int, frame: object) -> None:
        if self.exit_code:
            raise KeyboardInterrupt
        self.exit_code = 128 + number
        print("stopping after this step (Ctrl-C again stops at once)", file=sys.stderr, flush=True)
