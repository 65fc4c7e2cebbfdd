"""`bevcli export-onnx` writes a model as an ONNX file; `bevcli quantize` writes that file in INT8."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

import bevcli
from bevcli.cli.bridge import Part, argument, model_option
from bevcli.inference import FILE_ENGINE, ModelOptions
from bevcli.options import option, options
from bevcli.printing import say
from bevcli.workshop.engines import FileOptions, OnnxOptions

PANEL = "Deploy"


def export_onnx(
    model: Annotated[
        str | None,
        model_option(
            "tiny, small, base, demo, photographs, v2-t1-base, v2-t1, v2-t2, v2-t8, or a FILE.toml. Default: the model "
            "that WEIGHTS fit, else photographs."
        ),
    ] = None,
    *,
    model_options: Annotated[ModelOptions, Part(only=("weights", "untrained"))],
    file: FileOptions,
    options: OnnxOptions,
) -> None:
    """Write one step of a model as an ONNX file of standard operators, without plugins.

    The number of cameras is fixed, the batch is one; calibrations are inputs. What the model remembers is an input and
    an output: the BEV map, or with v2 models image features. The file's metadata documents every input and output.
    docs/deploy.md shows how to run it. Needs pip install 'bevcli[onnx]'.
    """
    from bevcli.workshop.engines import exported

    loaded = bevcli.load_model(model, options=replace(model_options, device="cpu"))
    drive = None if options.check is None else bevcli.open_sequence(options.check, rate_hz=loaded.config.rate_hz)
    target, loaded = exported.write_model(loaded, file, options)
    say(f"{target}: {target.stat().st_size / 1e6:.1f} MB")
    if drive is not None:
        say("\n".join(exported.difference_lines(list(exported.check_exported(target, loaded, drive)))))


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
    from bevcli.workshop.engines import exported

    if not options.calibrate:
        raise typer.BadParameter("is missing (expected a drive)", param_hint="--int8-drive")
    engine = model_options.engine or FILE_ENGINE
    drive = None
    if options.check is not None:
        drive = bevcli.open_sequence(options.check, rate_hz=exported.load_exported(model, engine).config.rate_hz)
    target = exported.write_quantized(model, options.calibrate, options.frames, engine, file)
    say(f"{target}: {target.stat().st_size / 1e6:.1f} MB")
    if drive is not None:
        say("\n".join(exported.difference_lines(list(exported.check_exported(target, model, drive, engine)))))
