"""`bevcli bench`: the speed of a model on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from bevcli.cli.input_options import complete_model
from bevcli.cli.run_options import DeviceOption, EngineOption, PrecisionOption


def bench(
    model: Annotated[
        str,
        typer.Option(
            autocompletion=complete_model,
            help="tiny, small, base, v2-t1-base, v2-t1, v2-t2, v2-t8, uniad-track-map, a FILE.toml or a FILE.onnx.",
        ),
    ] = "tiny",
    device: DeviceOption = "auto",
    engine: EngineOption = None,
    precision: PrecisionOption = None,
    frames: Annotated[int, typer.Option(min=1, help="Number of timed frames, after the warm-up.")] = 5,
    against: Annotated[
        Literal["plain"] | None,
        typer.Option(help="Also run the plain version; compare times and results.", show_default=False),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")] = False,
    profile: Annotated[
        Path | None,
        typer.Option(metavar="OUT", help="Write PyTorch's profile of one frame (open it at chrome://tracing)."),
    ] = None,
    table: Annotated[
        Path | None,
        typer.Option(metavar="OUT", help="Measure all models in all precisions, and write the table of docs/speed.md."),
    ] = None,
) -> None:
    """Time every stage of a model on made-up images and weights, next to this machine's peak throughput.

    The peak throughput is the rate of matrix products and of copying memory, measured in the same run. Nothing else
    should run on the machine at the same time.
    """
    import json

    from bevcli.benchmark.measure import BenchmarkSettings, run_benchmark
    from bevcli.benchmark.table import write_table
    from bevcli.config import load_config
    from bevcli.engines.exported import SUFFIX
    from bevcli.pipeline.model_loading import choose_device, choose_precision, load_model, needs_exported_file

    target = choose_device(device)
    if table is not None:
        write_table(table, target, frames)
        typer.echo(f"wrote {table}", err=True)
        return
    exported = None
    if model.endswith(SUFFIX):
        exported = load_model(model, device=device, precision=precision, engine=engine)
        if against is not None or profile is not None:
            exported.require_parts("--against" if profile is None else "--profile")
    elif engine is not None:
        raise needs_exported_file(engine, model)
    settings = BenchmarkSettings(
        load_config(model) if exported is None else exported.config,
        target if exported is None else exported.device,
        choose_precision(precision, target),
        frames,
        against == "plain",
        profile,
        exported,
    )
    result = run_benchmark(settings)
    print(json.dumps(result.as_data(), indent=1) if as_json else result.text())
