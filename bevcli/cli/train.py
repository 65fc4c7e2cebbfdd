"""`bevcli train`: teach a model, on sequences with ground truth or on rendered drives."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from bevcli.errors import InputError, OutputError

if TYPE_CHECKING:
    from bevcli.model.bevformer import BEVFormerConfig
    from bevcli.training.drives import Drives
    from bevcli.training.validation import Validation


def train(
    config: Annotated[str, typer.Argument(help="A FILE.toml or a known model; its training table says how it learns.")],
    data: Annotated[
        list[Path] | None,
        typer.Option(metavar="DIR", help="A sequence with ground truth; bevcli convert makes them. Repeatable."),
    ] = None,
    rendered: Annotated[
        str | None,
        typer.Option(metavar="SEEDS", help="Rendered drives of these seeds instead: A:B (B exclusive), or A,B,C."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="For checkpoint, weights, curves and rendered drives. Default: runs/train-MODEL.", show_default=False
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in the output folder.")] = False,
    weights: Annotated[
        Path | None, typer.Option(help="Begin with these weights (fine-tuning), not with random ones.")
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Default: as the file says.", show_default=False)] = None,
    seed: Annotated[int, typer.Option(min=0, help="The same seed trains the same model.")] = 0,
    device: Annotated[
        Literal["auto", "cpu", "cuda"], typer.Option(help="auto takes a GPU where there is one.")
    ] = "auto",
) -> None:
    """Train the model of CONFIG; write weights.safetensors for `bevcli run --weights`, checkpoint and curves.

    The last drives are held out to evaluate on (`held_out` in the training table). A killed training goes on with
    --resume, to the same result. `torchrun --nproc-per-node N -m bevcli train …` trains with N processes, one a GPU or
    a CPU core, that learn from clips of their own and update together.
    """
    from dataclasses import replace

    import torch

    from bevcli.checkpoints import load_weights
    from bevcli.cli.progress import Progress
    from bevcli.config import TRAINING, load_config, load_table
    from bevcli.model.bevformer import BEVFormer
    from bevcli.pipeline.model_loading import choose_device
    from bevcli.training.team import join_team, leave_team
    from bevcli.training.trainer import Trainer, TrainingConfig, TrainingJob

    model_config, settings = load_config(config), load_table(config, TRAINING, TrainingConfig)
    settings = settings if steps is None else replace(settings, steps=steps)
    out = Path("runs") / f"train-{model_config.name}" if out is None else out
    drives, held_out = choose_drives(data or [], rendered, out, model_config, settings.held_out)
    prepare_folder(out, resume=resume)
    torch.manual_seed(seed)
    model = BEVFormer(model_config)
    if weights is not None:
        load_weights(weights, model, resample=True)
    chosen_device = choose_device(device)
    team = join_team(chosen_device)
    trainer = Trainer(TrainingJob(model, settings, drives, held_out, out, chosen_device, seed, team), resume=resume)
    if team.leads:
        with Progress(settings.steps - trainer.done, "steps") as progress:
            progress.message(f"{len(drives)} drives to learn from, {len(held_out)} to evaluate on; writing to {out}")
            trainer.run(progress.advance, lambda step, scores: progress.message(f"step {step}: {describe(scores)}"))
    else:
        trainer.run()
    leave_team(team)


def choose_drives(
    data: list[Path], rendered: str | None, out: Path, config: BEVFormerConfig, held_out: int
) -> tuple[Drives, Drives]:
    """The drives to learn from and those to evaluate on: the last `held_out`, or the same ones where that is 0."""
    from bevcli.training.drives import FIRST_HELD_OUT_SEED, part_of

    if rendered is not None and max(parse_seeds(rendered)) >= FIRST_HELD_OUT_SEED:
        raise InputError(f"--rendered {rendered}: seeds from {FIRST_HELD_OUT_SEED} on are kept for evaluation")
    drives = open_drives(data, rendered, out / "drives", config)
    count = len(drives)
    if count <= held_out:
        raise InputError(
            f"{count} drives are too few with {held_out} of them held out for evaluation: give more, "
            "or set held_out = 0 in [training] (then it evaluates on what it learned from)"
        )
    return part_of(drives, 0, count - held_out), part_of(drives, count - held_out if held_out else 0, count)


def open_drives(data: list[Path], rendered: str | None, cache: Path, config: BEVFormerConfig) -> Drives:
    """The drives in folders, or rendered from seeds and kept in `cache`. Raises InputError for both or neither."""
    from bevcli.training.drives import FolderDrives, RenderedDrives

    if bool(data) == (rendered is not None):
        raise InputError("which drives? give --data DIR (once or more), or --rendered SEEDS, not both")
    if rendered is None:
        return FolderDrives(data, config.rate_hz)
    return RenderedDrives(parse_seeds(rendered), cache, config)


def parse_seeds(text: str) -> list[int]:
    """ "A:B" or "A,B,C" -> seeds. Raises click's usage error."""
    try:
        start, colon, end = text.partition(":")
        seeds = list(range(int(start), int(end))) if colon else [int(part) for part in text.split(",")]
    except ValueError:
        seeds = []
    if not seeds or min(seeds) < 0:
        raise typer.BadParameter(f'"{text}" (expected A:B, or A,B,C)', param_hint="--rendered")
    return seeds


def prepare_folder(out: Path, *, resume: bool) -> None:
    """Makes the output folder; a training in it is gone on with or left alone, never overwritten."""
    if (out / "checkpoint.pt").exists() and not resume:
        raise OutputError(f"{out}: holds a training already; say --resume to go on with it, or --out DIR for another")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: cannot be made ({error.strerror})") from None


def describe(scores: Validation) -> str:
    """The scores on one line."""
    return ", ".join(f"{name} {value:.3f}" for name, value in scores.summary().items())
