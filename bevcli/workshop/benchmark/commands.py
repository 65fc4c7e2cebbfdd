"""`bevcli bench`: the speed of a model on this machine."""

import json
from pathlib import Path
from typing import Annotated, Literal

from bevcli.cli.bridge import Json, Part
from bevcli.errors import BevcliError
from bevcli.inference import ModelOptions, complete_model
from bevcli.options import option, options
from bevcli.printing import say
from bevcli.registry import known_models

PANEL = "Deploy"


@options()
class BenchOptions:
    """The model that is measured, and what is written."""

    model: str = option(
        reads="path or name",
        default="tiny",
        help=f"{', '.join(known_models())}, a FILE.toml or a FILE.onnx.",
        metavar="NAME|FILE",
        complete=complete_model,
    )
    frames: int = option(
        default=5, help="Number of timed frames, after the warm-up.", metavar="N", flag="--count", minimum=1
    )
    against: Literal["plain"] | None = option(
        default=None, help="Also run the plain version; compare times and results."
    )
    engines: bool = option(
        default=False, help="Time PyTorch and all installed engines side by side, alternating, and compare their boxes."
    )
    profile: Path | None = option(
        default=None, help="Write PyTorch's profile of one frame (open it at chrome://tracing).", metavar="OUT"
    )


def bench(
    model_options: Annotated[ModelOptions, Part(only=("device", "engine", "precision"))],
    options: BenchOptions,
    as_json: Json = False,
) -> None:
    """Time every stage of a model on made-up images and weights, next to this machine's peak throughput.

    The peak throughput is the rate of matrix products and of copying memory, measured in the same run. Nothing else
    should run on the machine at the same time.
    """
    from bevcli.workshop.benchmark import measure, versions

    if options.engines:
        if model_options != ModelOptions() or options.against is not None or options.profile is not None:
            raise BevcliError("--engines compares all of them on the CPU: leave out other options")
        table = versions.compare_engines(options.model, options.frames)
        say(json.dumps(table.as_data(), indent=1) if as_json else table.text())
        return
    model = versions.model_to_time(options.model, model_options)
    parts = " and ".join(f"--{name}" for name in ("against", "profile") if getattr(options, name) is not None)
    if parts:
        model.require_parts(parts)
    if model.needs_export:
        drive = versions.MadeUpDrive(versions.CALIBRATION_FRAMES)
        model = model.in_engine(drive.rig, drive)
    against_plain = options.against == "plain"
    result = measure.run_benchmark(model, options.frames, against_plain=against_plain, profile_path=options.profile)
    say(json.dumps(result.as_data(), indent=1) if as_json else result.text())
