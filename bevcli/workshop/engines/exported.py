"""An exported file in the place of a model, and its comparison with the model over a drive: `check_exported`."""

import contextlib
import copy
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from bevcli.errors import BevcliError, WeightsError
from bevcli.frame import BevMap, Drive, FrameResult
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Pose
from bevcli.inference import FILE_ENGINE, ModelOptions
from bevcli.inference.load import Model, load_model
from bevcli.inference.preprocess import Preprocessor, image_for_rig
from bevcli.inference.runner import Runner, RunnerState
from bevcli.model.prepare import prepare_for_inference
from bevcli.model.step import ModelOutputs, PreparedFrame
from bevcli.model.temporal_model import Memory, TemporalModel, model_class
from bevcli.options import refuse, spread
from bevcli.parsing.files import hash_of_file
from bevcli.printing import counted, reason_of
from bevcli.registry import load
from bevcli.sequences.files.calibration_file import read_calibration
from bevcli.sequences.open import open_sequence
from bevcli.workshop.engines import FileOptions, OnnxOptions
from bevcli.workshop.engines.export_form import ExportForm, pixels_of
from bevcli.workshop.engines.export_onnx import (
    calibration_images,
    export_onnx as write_onnx,
    quantize as write_int8,
    read_metadata,
)

Arrays = Mapping[str, np.ndarray]
NEAR_M = 0.1
CENTER = (0, 1, 4)  # columns of box codes
COMPARED = ("bev", "class_logits", "box_codes", "mask_logits", "mask_class_logits")  # outputs with columns of their own


class LoadedFile(nn.Module):
    """An exported file, loaded. A module without parameters, so that its time can be measured like any other part's."""

    metadata: Mapping[str, str]  # of the file: text by name
    input_shapes: Mapping[str, tuple[int, ...]]  # name of each input -> its shape
    outputs: tuple[str, ...]  # names of the outputs

    def forward(self, feed: Arrays) -> dict[str, np.ndarray]:
        """One step. feed: every input by name. Returns every output by name."""
        raise NotImplementedError


class ExportedModel(TemporalModel):
    """An exported file, run by an engine on the CPU.

    It has no parts to look into: sampling points of the attentions and times of single stages are not available.
    """

    stages: Mapping[str, str] = {"engine": "engine"}
    device = torch.device("cpu")
    digest: Tensor

    def __init__(self, file: Path, engine: LoadedFile) -> None:
        """Raises WeightsError for a file that is not of `bevcli export-onnx`, ConfigError for its model."""
        metadata = read_metadata(engine.metadata, file)
        super().__init__(metadata.config)
        self.file, self.engine, self.metadata = file, engine, metadata
        self._require(("images",), engine.input_shapes, "input")
        self.kind = model_class(self.config)
        self.form: ExportForm = self.kind.export_form(self.config, self.cameras)
        self._require((port.name for port in self.form.outputs(decode=False)), engine.outputs, "output")
        digest = bytes.fromhex(hash_of_file(file))
        # The only state of this module: it tells a resumed run whether the weights are the same.
        self.register_buffer("digest", torch.tensor(list(digest), dtype=torch.uint8))

    def _require(self, names: Iterable[str], present: Collection[str], role: str) -> None:
        missing = [name for name in names if name not in present]
        if missing:
            raise WeightsError(
                f"{self.file}: has no {role} {', '.join(missing)} (expected a file of bevcli export-onnx)"
            )

    @property
    def cameras(self) -> int:
        """N, the number of cameras that the file was exported for."""
        return self.engine.input_shapes["images"][1]

    def step(
        self, prepared: PreparedFrame, memory: Memory | None, upcoming: Sequence[PreparedFrame] = ()
    ) -> tuple[ModelOutputs, Memory]:
        """See `TemporalModel`. Raises WeightsError unless the file was exported for the frame's number of cameras."""
        count = prepared.images.shape[1]
        if count != self.cameras:
            raise WeightsError(
                f"{self.file}: takes {counted(self.cameras, 'cameras')}, but the sequence has {count}: "
                f"use `bevcli export-onnx --cameras {count}`"
            )
        if not prepared.pixels:  # prepared for the model itself, with which the file is compared
            prepared = replace(prepared, images=pixels_of(prepared.images, self.config.image), pixels=True)
        outputs = self.outputs_by_name(self.form.feed(prepared, memory))
        return self(outputs), self.form.memory(prepared, memory, outputs)

    def decode(self, outputs: ModelOutputs) -> Iterator[Boxes3D | BevMap | FrameResult]:
        """See `TemporalModel`. The class of the model decodes; it needs only the configuration of this one."""
        return self.kind.decode(self, outputs)

    def with_pose(self, memory: Memory, pose: Pose) -> Memory:
        """See `TemporalModel`; the memory is that of the model."""
        return self.kind.with_pose(self, memory, pose)

    def forward(self, outputs: Mapping[str, Tensor]) -> ModelOutputs:
        """The outputs as the model's own, with one decoder layer. outputs: of `outputs_by_name`."""
        return self.kind.outputs_type.of_names(outputs)

    def outputs_by_name(self, feed: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Every output of the file by name. feed: its inputs by name, see `ExportForm.feed`.

        Raises WeightsError where the engine cannot run the file, where an output has another shape than the model's,
        and where more cameras see one cell than the file has slots for.
        """
        try:
            outputs = self.engine({name: tensor.cpu().numpy() for name, tensor in feed.items()})
        except Exception as error:  # each engine has classes of its own
            reason = reason_of(error)
            raise WeightsError(f"{self.file}: fails when it runs ({reason:.300}); export it again") from error
        for port in self.form.outputs(decode=False):
            if (shape := outputs[port.name].shape) != port.shape:
                raise WeightsError(
                    f"{self.file}: output {port.name} has shape {shape} (expected {port.shape}); export it again"
                )
        most, slots = int(outputs["most_cameras_per_cell"][0]), self.metadata.cameras_per_cell
        if most > slots:
            raise WeightsError(
                f"{self.file}: takes {counted(slots, 'cameras')} per BEV cell, but the sequence has {most}: "
                f"use `bevcli export-onnx --cameras-per-cell {most}`"
            )
        return {name: torch.from_numpy(value) for name, value in outputs.items()}


def load_exported(file: Path, engine: str, threads: int | None = None) -> ExportedModel:
    """An exported file in the place of a model, see `Engine.open`. engine: a name of `bevcli.engines`."""
    exported: ExportedModel = load("bevcli.engines", engine).open(file, threads)
    return exported


@dataclass(frozen=True)
class FrameDifference:
    """The largest differences between the two runs in one frame."""

    frame: int  # index of the frame
    bev: float  # of the BEV map
    logits: float  # of the class logits
    box_m: float  # of the box centres, metres
    near: float  # share of the box centres that differ by at most 0.1 m, 0 to 1
    code: float  # of the other numbers of the box codes: logarithms of sizes, sine and cosine, m/s
    masks: float  # of the probabilities of the map's cells; 0 without segmentation
    further: Mapping[str, float] = field(default_factory=dict)  # of outputs that only this model has, by name


def check_exported(
    file: Path, reference: Model | Path, sequence: Drive, engine: str = "onnxruntime"
) -> Iterator[FrameDifference]:
    """Runs both over a drive, each with the state of its own last frame, and yields the differences frame by frame.

    Args:
        file: an exported file of the model.
        reference: the model, which runs on the CPU in float32; or another exported file of it.
        sequence: the drive. Frames without any image are left out.
        engine: the program that runs the file.

    Raises WeightsError where the file cannot be loaded, InputError where a frame cannot be read.
    """
    cpu = torch.device("cpu")
    network: TemporalModel
    if isinstance(reference, Path):
        network = load_exported(reference, engine)
    else:
        network = prepare_for_inference(reference.network, cpu)
    exported = load_exported(file, engine)
    preprocess = Preprocessor(exported.config)  # of the exported file, whose images have one size
    runners = [Runner(model, cpu) for model in (network, exported)]
    states: list[RunnerState[Any]] = [RunnerState(), RunnerState()]
    outputs: dict[Runner, ModelOutputs] = {}  # of the last step of each
    with contextlib.ExitStack() as hooks:
        for runner in runners:
            hook = runner.model.register_forward_hook(lambda *call, of=runner: outputs.update({of: call[2]}))
            hooks.enter_context(hook)
        for prepared in map(preprocess, map(sequence.load, range(len(sequence.stamps)))):
            if prepared.frame.images:
                states = [runner.step(state, prepared)[0] for runner, state in zip(runners, states, strict=True)]
                yield compare_outputs(prepared.frame.stamp.index, *(outputs[runner] for runner in runners))


def compare_outputs(frame: int, ours: ModelOutputs, theirs: ModelOutputs) -> FrameDifference:
    """The largest differences of the last layers and the BEV map of a frame."""
    codes = (ours.box_codes[-1] - theirs.box_codes[-1]).abs()
    distances = codes[..., CENTER].norm(dim=-1)
    others = [index for index in range(codes.shape[-1]) if index not in CENTER]
    probabilities = [
        maps.mask_logits[-1].sigmoid() * maps.class_logits[-1].sigmoid()[..., None]
        for maps in (ours.segmentation, theirs.segmentation)
        if maps is not None
    ]
    further = {name: tensor for name, tensor in ours.by_name.items() if name not in COMPARED}
    return FrameDifference(
        frame=frame,
        bev=_largest(ours.bev, theirs.bev),
        logits=_largest(ours.class_logits[-1], theirs.class_logits[-1]),
        box_m=distances.max().item(),
        near=(distances <= NEAR_M).float().mean().item(),
        code=codes[..., others].max().item(),
        masks=_largest(*probabilities) if len(probabilities) == 2 else 0.0,
        further={name: _largest(tensor, theirs.by_name[name]) for name, tensor in further.items()},
    )


def difference_lines(differences: list[FrameDifference]) -> list[str]:
    """A table, one line a frame, and the largest of each column; of the share of boxes, the smallest."""
    columns = ("bev", "logits", "box_m", "code", "masks")
    numbers = [(*(getattr(row, name) for name in columns), *row.further.values()) for row in differences]
    written = [[f"{number:.1e}" for number in row] for row in (*numbers, map(max, zip(*numbers, strict=True)))]
    near = [row.near for row in differences]
    firsts = [*((str(row.frame), f"{row.near:.1%}") for row in differences), ("largest", f"{min(near):.1%}")]
    heads = ("frame", "in 0.1 m", "BEV map", "logits", "centres m", "codes", "masks", *differences[0].further)
    rows = [heads, *((*first, *row) for first, row in zip(firsts, written, strict=True))]
    widths = [max(9, len(head)) for head in heads]
    return ["  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)) for row in rows]


def _largest(ours: Tensor, theirs: Tensor) -> float:
    return (ours - theirs).abs().max().item()


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
        model, options = for_rig(model, rig), replace(options, cameras=len(rig.cameras))
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


def for_rig(model: Model, rig: CameraRig) -> Model:
    """The model with images of one size, that of a rig, for an exported file: see `ImageConfig.focal_px`."""
    network = copy.copy(model.network)  # the copy has the same weights
    network.config = replace(model.config, image=image_for_rig(rig, model.config.image))
    return replace(model, network=network)
