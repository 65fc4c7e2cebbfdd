"""`export_onnx` and `quantize` as functions with the options of the commands as keywords."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from bevcli.errors import BevcliError
from bevcli.inference.load import Model, load_model
from bevcli.inference.options import FILE_ENGINE, ModelOptions
from bevcli.options import refuse, spread
from bevcli.sequences.files.calibration_file import read_calibration
from bevcli.sequences.open import open_sequence
from bevcli.workshop.engines import FileOptions, OnnxOptions
from bevcli.workshop.engines.export_onnx import calibration_images, export_onnx as write_onnx, quantize as write_int8
from bevcli.workshop.engines.exported import load_exported


def export_onnx(model: Model | str | Path | None = None, **options: Any) -> Path:
    """Write one step of a model as an ONNX file, as `bevcli export-onnx` does; return the file.

        bevcli.export_onnx("demo", out="demo.onnx", rig="samples/street/calibration.json", decode=True)

    Needs the extra `bevcli[onnx]`.

    Args:
        model: a `Model` in PyTorch, or what `load_model` takes.
        options: those of `OnnxOptions` (`opset`, `cameras`, `rig`, `decode`, …) without `check`, `out` and `force`, and
            `weights` and `untrained`, where `model` is no `Model`.

    Raises BevcliError for a model that cannot be exported, and OutputError where the file exists already.
    """
    of_model = () if isinstance(model, Model) else (ModelOptions,)
    file, onnx_options, *model_options, unknown = spread(options, FileOptions, OnnxOptions, *of_model)
    refuse(unknown, "export_onnx", FileOptions, OnnxOptions, *of_model)
    if onnx_options.check is not None:
        raise BevcliError("`check`: run a drive through both models, and compare their boxes")
    loaded = model if isinstance(model, Model) else load_model(model, options=replace(model_options[0], device="cpu"))
    return write_model(loaded, file, onnx_options)[0]


def write_model(model: Model, file: FileOptions, options: OnnxOptions) -> tuple[Path, Model]:
    """Write the file, see `export_onnx`; return it and the model as it is for the rig of the options."""
    model.require_parts("bevcli export-onnx")
    if options.rig is not None:
        if options.cameras is not None:
            raise BevcliError("`rig` states the number of cameras: leave `cameras` out")
        rig = read_calibration(options.rig)
        model, options = model.for_rig(rig), replace(options, cameras=len(rig.cameras))
    target = file.target(Path(f"{model.name}.onnx"))
    contents, untrained = model.contents(), model.untrained
    write_onnx(model.network, target, options, contents=contents, untrained=untrained, bundled=model.bundled)
    return target, model


def quantize(
    model: str | Path, drives: Iterable[str | Path], *, frames: int = 16, engine: str | None = None, **options: Any
) -> Path:
    """Write a copy of an exported model that computes in INT8, as `bevcli quantize` does; return the file.

        bevcli.quantize("demo.onnx", ["samples/street"], out="demo-int8.onnx")

    Needs the extra `bevcli[onnx]`.

    Args:
        model: a file of `export_onnx`.
        drives: their images give the ranges of the numbers.
        frames: how many of them, evenly spaced over all drives.
        engine: reads the file. Default: "onnxruntime".
        options: `out` and `force`.

    Raises BevcliError for a file that cannot be read, InputError for a drive, and OutputError where the file exists.
    """
    file, unknown = spread(options, FileOptions)
    refuse(unknown, "quantize", FileOptions)
    return write_quantized(Path(model), tuple(map(Path, drives)), frames, engine or FILE_ENGINE, file)


def write_quantized(model: Path, drives: tuple[Path, ...], frames: int, engine: str, file: FileOptions) -> Path:
    """Write the file, see `quantize`."""
    network = load_exported(model, engine)
    target = file.target(model.with_name(f"{model.stem}-int8.onnx"))
    opened = [open_sequence(path, rate_hz=network.config.rate_hz) for path in drives]
    write_int8(model, calibration_images(network.config, network.cameras, opened, frames), target)
    return target
