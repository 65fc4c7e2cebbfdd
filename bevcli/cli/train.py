"""`bevcli train`: train a model on sequences with ground truth or on rendered drives."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer


def train(
    config: Annotated[str, typer.Argument(help="A model name or a FILE.toml. Its training table holds the settings.")],
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
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 0,
    device: Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="auto uses a GPU if there is one.")] = "auto",
) -> None:
    """Train a model; write its weights, checkpoints and learning curves.

    The last drives are held out for evaluation (`held_out` in the training table). An interrupted training continues
    with --resume; on a CPU the result is the same. Run weights.safetensors with `bevcli run --weights`.

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
        seed=seed,
        resume=resume,
    )
    trainer = Trainer(job, resume=resume)
    if job.group.leads:
        with Progress(job.config.steps - trainer.done, "steps") as progress:
            progress.message(
                f"drives: {len(job.drives)} to train on, {len(job.held_out)} to evaluate on; output: {job.out}"
            )
            trainer.run(progress.advance, lambda step, scores: progress.message(f"step {step}: {scores}"))
    else:
        trainer.run()
    leave_process_group(job.group)
