"""`bevcli bench`: the speed of a model on this machine."""

import json
from typing import Annotated

import typer

from bevcli.benchmark.options import BenchOptions
from bevcli.cli.bridge import Json, Part, in_group
from bevcli.inference.options import ModelOptions


@in_group("Deploy")
def bench(
    model_options: Annotated[ModelOptions, Part(only=("device", "engine", "precision"))],
    options: BenchOptions,
    as_json: Json = False,
) -> None:
    """Time every stage of a model on made-up images and weights, next to this machine's peak throughput.

    The peak throughput is the rate of matrix products and of copying memory, measured in the same run. Nothing else
    should run on the machine at the same time.
    """
    from bevcli.benchmark.measure import run_benchmark
    from bevcli.benchmark.result import write_table
    from bevcli.config import load_config
    from bevcli.engines.exported import SUFFIX
    from bevcli.inference.load import choose_device, choose_precision, load_model, needs_exported_file

    target = choose_device(model_options.device)
    if options.table is not None:
        write_table(options.table, target, options.frames)
        typer.echo(f"wrote {options.table}", err=True)
        return
    exported = None
    if options.model.endswith(SUFFIX):
        exported = load_model(options.model, options=model_options)
        if options.against is not None or options.profile is not None:
            exported.require_parts("`against`" if options.profile is None else "`profile`")
    elif model_options.engine is not None:
        raise needs_exported_file(model_options.engine, options.model)
    config, device = (load_config(options.model), target) if exported is None else (exported.config, exported.device)
    precision = choose_precision(model_options.precision, target)
    result = run_benchmark(config, device, precision, options, exported)
    print(json.dumps(result.as_data(), indent=1) if as_json else result.text())
