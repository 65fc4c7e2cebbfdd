"""`bevcli quantize`: an exported model with backbone and neck in INT8."""

from pathlib import Path
from typing import Annotated

import typer

from bevcli.cli.bridge import Part, argument
from bevcli.inference.options import FILE_ENGINE, ModelOptions
from bevcli.options import option, options
from bevcli.printing import say
from bevcli.workshop.engines.options import FileOptions

PANEL = "Deploy"


@options()
class QuantizeOptions:
    """The drives whose images calibrate a quantised file, and a check of it."""

    calibrate: tuple[Path, ...] = option(
        reads="path",
        default=(),
        help="Drive whose images give the ranges of the numbers for int8; required. Repeatable.",
        metavar="SEQUENCE",
        flag="--int8-drive",
        repeatable=True,
    )
    frames: int = option(
        default=16,
        help="Number of frames for the calibration, evenly spaced over all drives.",
        metavar="N",
        flag="--count",
        minimum=1,
    )
    check: Path | None = option(
        reads="path",
        default=None,
        help="Run this drive through both files, and print the largest differences.",
        metavar="SEQUENCE",
    )


def quantize(
    model: Annotated[Path, argument("A file of `bevcli export-onnx`.", metavar="FILE.onnx")],
    model_options: Annotated[ModelOptions, Part(only=("engine",))],
    file: FileOptions,
    options: QuantizeOptions,
) -> None:
    """Write a copy of an exported model whose backbone and neck compute in INT8, for CPUs.

    `bevcli run`, `validate` and `bench` take the new file as `--model`. Check the accuracy on drives of your own with
    `bevcli validate`. Needs pip install 'bevcli[onnx]'.
    """
    from bevcli.inference.preprocess import calibration_images
    from bevcli.sequences.open import open_sequence
    from bevcli.workshop.engines.differences import check_exported, difference_lines
    from bevcli.workshop.engines.engine import load_exported
    from bevcli.workshop.engines.export_onnx import quantize as write_quantized

    if not options.calibrate:
        raise typer.BadParameter("is missing (expected a drive)", param_hint="--int8-drive")
    engine = model_options.engine or FILE_ENGINE
    network = load_exported(model, engine)
    config = network.config
    target = file.target(model.with_name(f"{model.stem}-int8.onnx"))
    drives = [open_sequence(path, rate_hz=config.rate_hz) for path in options.calibrate]
    drive = None if options.check is None else open_sequence(options.check, rate_hz=config.rate_hz)
    write_quantized(model, calibration_images(config, network.cameras, drives, options.frames), target)
    say(f"{target}: {target.stat().st_size / 1e6:.1f} MB")
    if drive is not None:
        say("\n".join(difference_lines(list(check_exported(target, model, drive, engine)))))
