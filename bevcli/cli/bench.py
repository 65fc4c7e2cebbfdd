"""`bevcli bench`: how fast is a model here, and how fast could it be?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer


def bench(
    model: Annotated[str, typer.Option(help="tiny, small, base, or a FILE.toml.")] = "tiny",
    device: Annotated[
        Literal["auto", "cpu", "cuda"], typer.Option(help="auto takes a GPU where there is one.")
    ] = "auto",
    precision: Annotated[
        Literal["fp32", "bf16", "fp16"] | None,
        typer.Option(help="Default: fp32 on the CPU, bf16 on a GPU.", show_default=False),
    ] = None,
    frames: Annotated[int, typer.Option(min=1, help="How many frames are timed, after the warm-up.")] = 5,
    against: Annotated[
        Literal["plain"] | None,
        typer.Option(help="Also run the plain version, in turn, and compare times and results.", show_default=False),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object in place of the lines.")] = False,
    profile: Annotated[
        Path | None,
        typer.Option(metavar="OUT", help="Write PyTorch's profile of one frame (open it at chrome://tracing)."),
    ] = None,
    table: Annotated[
        Path | None,
        typer.Option(metavar="OUT", help="Run all models and precisions, and write the table of docs/speed.md."),
    ] = None,
) -> None:
    """Time every stage of a model on made-up images and weights, beside what this machine can do at most.

    The limits are the rates of matrix products and of copying memory, measured in the same run. Nothing else should
    run on the machine meanwhile.
    """
    import json

    from bevcli.benchmark.measure import BenchmarkSettings, run_benchmark
    from bevcli.benchmark.table import write_table
    from bevcli.config import load_config
    from bevcli.pipeline.model_loading import choose_device, choose_precision

    target = choose_device(device)
    if table is not None:
        write_table(table, target, frames)
        typer.echo(f"wrote {table}", err=True)
        return
    settings = BenchmarkSettings(
        load_config(model), target, choose_precision(precision, target), frames, against == "plain", profile
    )
    result = run_benchmark(settings)
    print(json.dumps(result.as_data(), indent=1) if as_json else result.text())
