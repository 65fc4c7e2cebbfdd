"""An exported file in the place of a model."""

import hashlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from bevcli.config import config_of_table
from bevcli.errors import WeightsError
from bevcli.frame import BevMap, FrameResult
from bevcli.geometry.boxes import Boxes3D
from bevcli.model.config import ModelConfig
from bevcli.model.segmentation import SegmentationOutputs
from bevcli.model.step import ModelOutputs, PreparedFrame
from bevcli.model.temporal_model import Memory, TemporalModel, model_class
from bevcli.parsing.documents import parse_json
from bevcli.printing import counted, reason_of
from bevcli.registry import load
from bevcli.workshop.engines.engine import Engine
from bevcli.workshop.engines.export_form import export_form, pixels_of

SUFFIX = ".onnx"

# The part of the metadata that bevcli itself reads, to run the file: the contents of the model's TOML file as JSON,
# the number of cameras that may see one cell, whether the weights are random or those of the package, and the precision
# of backbone and neck.
METADATA = ("config", "cameras_per_cell", "untrained", "bundled", "precision")


@dataclass(frozen=True)
class ExportedFile:
    """The metadata of an exported file that describes its model.

    Attributes:
        config: of the model.
        contents: the contents of the model's TOML file, its table of the tracker included.
        cameras_per_cell: the number of cameras that may see one cell of the BEV map.
        untrained: whether the weights are random.
        bundled: whether the weights are those of the package.
        precision: of backbone and neck, "fp32" or "int8".
    """

    config: ModelConfig
    contents: dict[str, Any]
    cameras_per_cell: int
    untrained: bool
    bundled: bool
    precision: Literal["fp32", "int8"]


def read_metadata(metadata: Mapping[str, str], file: Path) -> ExportedFile:
    """Reads the metadata of a file of `bevcli export-onnx`. Raises WeightsError, or ConfigError for its model."""
    missing = [name for name in METADATA if name not in metadata]
    if missing:
        raise WeightsError(
            f"{file}: its metadata lacks {', '.join(missing)} (expected a file of bevcli export-onnx of this version)"
        )
    contents, slots, untrained, bundled = (parse_json(metadata[name].encode(), file) for name in METADATA[:4])
    if not isinstance(contents, dict) or type(slots) is not int:
        raise WeightsError(
            f"{file}: its metadata config or cameras_per_cell is wrong (expected a table and an integer)"
        )
    precision: Literal["fp32", "int8"] = "int8" if metadata["precision"] == "int8" else "fp32"
    config = config_of_table(contents, str(file))
    # The file's images have one size, for every rig.
    config = replace(config, image=replace(config.image, focal_px=None, max_pixels=None))
    return ExportedFile(config, contents, slots, untrained is not False, bundled is True, precision)


class ExportedModel(TemporalModel):
    """An exported file, run by an engine on the CPU. `load_exported` makes one.

    It has no parts to look into: sampling points of the attentions and times of single stages are not available.
    """

    stages: Mapping[str, str] = {"engine": "engine"}
    takes_pixels = True
    device = torch.device("cpu")
    digest: Tensor

    def __init__(self, file: Path, engine: Engine, metadata: ExportedFile) -> None:
        super().__init__(metadata.config)
        self.file, self.engine, self.metadata = file, engine, metadata
        self._require(("images",), engine.input_shapes, "input")
        self.kind = model_class(self.config)
        self.form = export_form(self.config, self.cameras)
        self._require((port.name for port in self.form.outputs(decode=False)), engine.outputs, "output")
        with file.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").digest()
        # The only state of this module: it tells a resumed run whether the weights are the same.
        self.register_buffer("digest", torch.tensor(list(digest), dtype=torch.uint8))

    def _require(self, names: Iterable[str], found: Collection[str], kind: str) -> None:
        missing = [name for name in names if name not in found]
        if missing:
            raise WeightsError(
                f"{self.file}: has no {kind} {', '.join(missing)} (expected a file of bevcli export-onnx)"
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
        found = self.outputs_by_name(self.form.feed(prepared, memory))
        return self(found), self.form.memory(prepared, memory, found)

    def decode(self, outputs: ModelOutputs) -> Iterator[Boxes3D | BevMap | FrameResult]:
        """See `TemporalModel`. The class of the model decodes; it needs only the configuration of this one."""
        return self.kind.decode(self, outputs)

    def forward(self, found: Mapping[str, Tensor]) -> ModelOutputs:
        """The outputs as the model's own, with one decoder layer. found: of `outputs_by_name`."""
        segmentation = None
        if "mask_logits" in found:
            masks, classes = found["mask_logits"][None], found["mask_class_logits"][None]
            segmentation = SegmentationOutputs(masks, classes, locations=torch.zeros(0, 1, 0, 4))
        logits, codes = found["class_logits"][None], found["box_codes"][None]
        return self.form.model_outputs(ModelOutputs(found["bev"], logits, codes, segmentation), found)

    def outputs_by_name(self, feed: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Every output of the file by name. feed: its inputs by name, see `ExportForm.feed`.

        Raises WeightsError where the engine cannot run the file, where an output has another shape than the model's,
        and where more cameras see one cell than the file has slots for.
        """
        try:
            found = self.engine({name: tensor.cpu().numpy() for name, tensor in feed.items()})
        except Exception as error:  # each engine has classes of its own
            reason = reason_of(error)
            raise WeightsError(f"{self.file}: fails when it runs ({reason:.300}); export it again") from error
        for port in self.form.outputs(decode=False):
            if (shape := found[port.name].shape) != port.shape:
                raise WeightsError(
                    f"{self.file}: output {port.name} has shape {shape} (expected {port.shape}); export it again"
                )
        most, slots = int(found["most_cameras_per_cell"][0]), self.metadata.cameras_per_cell
        if most > slots:
            raise WeightsError(
                f"{self.file}: takes {counted(slots, 'cameras')} per BEV cell, but the sequence has {most}: "
                f"use `bevcli export-onnx --cameras-per-cell {most}`"
            )
        return {name: torch.from_numpy(value) for name, value in found.items()}


def load_exported(file: Path, engine: str, threads: int | None = None) -> ExportedModel:
    """Loads an exported file.

    Args:
        file: of `bevcli export-onnx` or `bevcli quantize`.
        engine: the program that runs it, a name of `bevcli.engines`.
        threads: that it uses; None takes PyTorch's number.

    Raises:
        BevcliError: the engine is unknown or not installed.
        WeightsError: the file is missing, cannot be loaded, or is not of `bevcli export-onnx`.
        ConfigError: the model in its metadata is wrong.
    """
    start: type[Engine] = load("bevcli.engines", engine)
    loaded = start(file, torch.get_num_threads() if threads is None else threads)
    return ExportedModel(file, loaded, read_metadata(loaded.metadata, file))
