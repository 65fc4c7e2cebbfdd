"""From a drive to Predictions: `run`, the options of a model, and those of its steps."""

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bevcli.errors import InputError
from bevcli.model import AnyPrecision
from bevcli.options import option, options, parse_pairs, refuse, spread
from bevcli.registry import entries, known_models

if TYPE_CHECKING:
    from bevcli.frame import Drive, Frame, Prediction
    from bevcli.inference.load import Model

PHOTOGRAPHS, RENDERED = "photographs", "demo"  # models of the package: for real images, for rendered ones
TORCH = "torch"  # the value of `engine` beside the registered engines
EXPORTED_SUFFIX, FILE_ENGINE = ".onnx", "onnxruntime"  # of exported files, and the engine that runs them by default


def complete_model(incomplete: str) -> Iterator[str]:
    """The known models, then the published weights, for completion in a shell, where typer keeps those that fit."""
    yield from known_models()
    from bevcli.published import read_sources

    yield from sorted(read_sources().keys() - set(known_models()))


@options("Model")
class ModelOptions:
    """The options of `load_model`."""

    model: str | Path | None = option(
        reads="path or name",
        default=None,
        help=f"{', '.join(known_models())}, a name of `bevcli weights list`, hf:OWNER/NAME[@REVISION] of the "
        "Hugging Face Hub, a FILE.toml or a FILE.onnx of `bevcli export-onnx`. Default: the model that WEIGHTS fit, "
        "else photographs, or demo where bevcli rendered the drive.",
        metavar="NAME|FILE",
        complete=complete_model,
    )
    weights: Path | None = option(
        reads="path",
        default=None,
        help="An official .pth file or a .safetensors file. Default: the weights in the package (demo, "
        "photographs), or those that `bevcli weights fetch` has downloaded.",
    )
    fetch: bool = option(
        default=False, help="Download the weights of MODEL if they are not there yet; of a hub, the newest version."
    )
    weights_dir: Path | None = option(
        default=None,
        help="Folder of downloaded weights. Default: $BEVCLI_WEIGHTS_DIR, else ~/.cache/bevcli/weights.",
        metavar="DIR",
    )
    untrained: bool = option(default=False, help="Use random weights; all outputs are labelled UNTRAINED.")
    device: str = option(
        default="auto",
        help="auto uses a CUDA GPU if there is one; cuda:1 is the second one; mps is the GPU of a Mac (untried).",
        metavar="auto|cpu|cuda|cuda:N|mps",
    )
    engine: str | None = option(
        default=None,
        help="Program that computes the model: torch, openvino, onnxruntime, or that of an installed package. A named "
        "model is exported once. Default: torch; openvino with int8 if it is installed; onnxruntime for a FILE.onnx.",
        metavar="torch|NAME",
        complete=lambda incomplete: [TORCH, *entries("bevcli.engines")],
    )
    precision: AnyPrecision | None = option(
        default=None,
        help="Precision of the image features. int8 is for a CPU, and needs an engine. Default: fp32 on a CPU, bf16 on "
        "a GPU.",
    )
    calibrate_with: Path | None = option(
        reads="path",
        default=None,
        help="Drive whose first frames give the ranges of numbers for int8. Default: the first drive that is run.",
        metavar="SEQUENCE",
        flag="--int8-drive",
    )


@options("Model")
class StepOptions:
    """The options of the steps of a model.

    attention: fill in `Prediction.attention`; that of an exported file never is.
    probes: x, y in metres, bev frame: BEV cells whose sampling points it shows. They imply `attention`.
    """

    temporal: bool = option(default=True, help="Use the frames before (and after).", flag="--temporal/--no-temporal")
    track: bool = option(
        default=True,
        help="Give boxes identities over time, and write tracks.csv. A UniAD with history gives its own.",
        flag="--track/--no-track",
    )
    cameras: Mapping[str, str] = option(
        default_factory=dict,
        help="Use the embedding of MODEL_CAMERA for camera NAME. Repeatable. Default: the model's camera of the same "
        "name, else the one with the nearest viewing direction.",
        flag="--camera",
        metavar="NAME=MODEL_CAMERA",
        parse=partial(parse_pairs, expected="NAME=MODEL_CAMERA"),
        repeatable=True,
    )
    unseen: bool = option(
        default=False,
        help="Show and count boxes where no camera looks as all others. Default: predictions.json marks them, and they "
        "are left out, but for those of a track that a camera saw in the last 3 s.",
    )
    command: str | None = option(
        default=None,
        help="Command of the driver, which marks one of the planned paths of a model that plans: straight, left or "
        "right, or a file with a command by frame index. Default: none is marked.",
        metavar="NAME|FILE.json",
    )
    attention: bool = False
    probes: tuple[tuple[float, float], ...] = ()


def run(model: "Model", sequence: "Drive", **options: Any) -> Iterator[tuple["Frame", "Prediction"]]:
    """Runs a model over a sequence, frame by frame; the BEV map of a frame is the history of the next.

        for frame, prediction in bevcli.run(model, drive):
            print(frame.stamp.index, len(prediction.boxes))

    Frames are read and prepared in the background. Nothing is kept of a frame after it was yielded.

    Args:
        model: of `load_model`.
        sequence: of `open_sequence`.
        options: those of `StepOptions`: `temporal`, `track`, `attention`, `probes`, `cameras`, `command`.

    Raises:
        InputError: a frame cannot be read, a probe lies outside the BEV grid, a camera or a command is unknown, or the
            attention of an exported file is asked for.
    """
    for argument, value, maker in (("model", model, "load_model"), ("sequence", sequence, "open_sequence")):
        if isinstance(value, str | Path):
            raise InputError(f"`{argument}={value}`: is a text or path: pass what `bevcli.{maker}` returns for it")
    step_options, rest = spread(options, StepOptions)
    refuse(rest, "run", StepOptions)
    shows = step_options.attention or step_options.probes
    runner = model.in_engine(sequence.rig, sequence, parts="attention and probes" if shows else "").runner(step_options)
    return ((frame, prediction) for frame, prediction, _ in runner.run(sequence))
