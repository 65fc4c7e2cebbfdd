"""`bevcli bench`: the speed of a model on this machine."""

import json
from typing import TYPE_CHECKING, Annotated

from bevcli.cli.bridge import Json, Part, as_flags
from bevcli.errors import BevcliError
from bevcli.inference.options import ModelOptions
from bevcli.printing import say
from bevcli.workshop.benchmark.options import BenchOptions

if TYPE_CHECKING:
    import torch

    from bevcli.inference.load import Model

PANEL = "Deploy"


def bench(
    model_options: Annotated[ModelOptions, Part(only=("device", "engine", "precision"))],
    options: BenchOptions,
    as_json: Json = False,
) -> None:
    """Time every stage of a model on made-up images and weights, next to this machine's peak throughput.

    The peak throughput is the rate of matrix products and of copying memory, measured in the same run. Nothing else
    should run on the machine at the same time.
    """
    from bevcli.cli.progress import engine_bar
    from bevcli.config import load_config
    from bevcli.inference.load import choose_device, choose_precision
    from bevcli.workshop.benchmark.engines import compare_engines
    from bevcli.workshop.benchmark.measure import run_benchmark
    from bevcli.workshop.benchmark.result import write_table

    target = choose_device(model_options.device)
    if options.table is not None:
        write_table(options.table, target, options.frames)
        say(f"wrote {options.table}", err=True)
        return
    if options.engines:
        if model_options != ModelOptions() or options.against is not None or options.profile is not None:
            raise BevcliError("`engines` compares all of them on the CPU: leave out other options")
        with engine_bar() as show:
            table = compare_engines(load_config(options.model), options.frames, show)
        say(json.dumps(table.as_data(), indent=1) if as_json else as_flags(table.text()))
        return
    exported = _exported(options, model_options, target)
    config, device = (load_config(options.model), target) if exported is None else (exported.config, exported.device)
    precision = "fp32" if model_options.precision == "int8" else choose_precision(model_options.precision, target)
    result = run_benchmark(config, device, precision, options, exported)
    say(json.dumps(result.as_data(), indent=1) if as_json else result.text())


def _exported(options: BenchOptions, model_options: ModelOptions, device: "torch.device") -> "Model | None":
    """The exported file, or a model with made-up weights in the engine that is asked for; None for PyTorch."""
    from bevcli.cli.progress import in_engine_with_bar
    from bevcli.config import load_config
    from bevcli.inference.load import Model, load_model
    from bevcli.workshop.benchmark.made_up import MadeUpDrive, made_up_model
    from bevcli.workshop.engines.engine_choice import engine_choice
    from bevcli.workshop.engines.exported import SUFFIX
    from bevcli.workshop.engines.in_engine import CALIBRATION_FRAMES

    parts = " and ".join(f"`{name}`" for name in ("against", "profile") if getattr(options, name) is not None)
    if options.model.endswith(SUFFIX):
        found = load_model(options.model, options=model_options)
        if parts:
            found.require_parts(parts)
        return found
    config = load_config(options.model)
    choice = engine_choice(model_options, config, device)
    if choice is None:
        return None
    found = in_engine_with_bar(Model(made_up_model(config), choice=choice), MadeUpDrive(CALIBRATION_FRAMES), parts)
    return found if found.is_exported else None
