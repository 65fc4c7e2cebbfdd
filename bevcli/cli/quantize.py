"""`bevcli quantize`: an exported model with backbone and neck in INT8."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bevcli.cli.run_options import EngineOption


def quantize(
    model: Annotated[Path, typer.Argument(metavar="FILE.onnx", help="A file of `bevcli export-onnx`.")],
    calibrate: Annotated[
        list[Path],
        typer.Option(metavar="SEQUENCE", help="Drive whose images give the ranges of the numbers. Repeatable."),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Default: FILE-int8.onnx.", show_default=False)
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file if it exists.")] = False,
    frames: Annotated[
        int, typer.Option(min=1, help="Number of frames for the calibration, evenly spaced over all drives.")
    ] = 16,
    check: Annotated[
        Path | None,
        typer.Option(
            metavar="SEQUENCE",
            help="Run this drive through both files, and print the largest differences.",
            show_default=False,
        ),
    ] = None,
    engine: EngineOption = None,
) -> None:
    """Write a copy of an exported model whose backbone and neck compute in INT8, for CPUs.

    `bevcli run`, `validate` and `bench` take the new file as `--model`. Check the accuracy on drives of your own with
    `bevcli validate`. Needs pip install 'bevcli\\[onnx]'.
    """
    from bevcli.benchmark.exported import compare_exported, difference_lines
    from bevcli.engines.exported import load_exported
    from bevcli.engines.quantize import quantize as write_quantized
    from bevcli.errors import OutputError
    from bevcli.pipeline.calibration_images import calibration_images
    from bevcli.sequences.open import open_sequence

    network = load_exported(model, engine or "onnxruntime")
    config = network.config
    target = model.with_name(f"{model.stem}-int8.onnx") if out is None else out
    if target.exists() and not force:
        raise OutputError(f"{target}: already exists; choose another name, or pass --force to overwrite it")
    drives = [open_sequence(path, rate_hz=config.rate_hz) for path in calibrate]
    drive = None if check is None else open_sequence(check, rate_hz=config.rate_hz)
    write_quantized(model, calibration_images(config, network.cameras, drives, frames), target)
    typer.echo(f"{target}: {target.stat().st_size / 1e6:.1f} MB")
    if drive is not None:
        typer.echo("\n".join(difference_lines(list(compare_exported(target, model, drive, engine or "onnxruntime")))))
