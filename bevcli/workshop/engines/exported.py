"""An exported file in the place of a model."""

import hashlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from bevcli.errors import WeightsError
from bevcli.frame import BevMap, FrameResult
from bevcli.geometry.boxes import Boxes3D
from bevcli.model.segmentation import SegmentationOutputs
from bevcli.model.step import ModelOutputs, PreparedFrame
from bevcli.model.temporal_model import Memory, TemporalModel, model_class
from bevcli.printing import counted, reason_of
from bevcli.workshop.engines.export_form import export_form, pixels_of
from bevcli.workshop.engines.export_onnx import read_metadata

Arrays = Mapping[str, np.ndarray]


class LoadedFile(nn.Module):
    """An exported file, loaded. A module without parameters, so that its time can be measured like any other part's.

    Attributes:
        metadata: of the file: text by name.
        input_shapes: name of each input -> its shape.
        outputs: names of the outputs.
    """

    metadata: Mapping[str, str]
    input_shapes: Mapping[str, tuple[int, ...]]
    outputs: tuple[str, ...]

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
        self.form = export_form(self.config, self.cameras)
        self._require((port.name for port in self.form.outputs(decode=False)), engine.outputs, "output")
        with file.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").digest()
        # The only state of this module: it tells a resumed run whether the weights are the same.
        self.register_buffer("digest", torch.tensor(list(digest), dtype=torch.uint8))

    def _require(self, names: Iterable[str], present: Collection[str], kind: str) -> None:
        missing = [name for name in names if name not in present]
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
        outputs = self.outputs_by_name(self.form.feed(prepared, memory))
        return self(outputs), self.form.memory(prepared, memory, outputs)

    def decode(self, outputs: ModelOutputs) -> Iterator[Boxes3D | BevMap | FrameResult]:
        """See `TemporalModel`. The class of the model decodes; it needs only the configuration of this one."""
        return self.kind.decode(self, outputs)

    def forward(self, outputs: Mapping[str, Tensor]) -> ModelOutputs:
        """The outputs as the model's own, with one decoder layer. outputs: of `outputs_by_name`."""
        segmentation = None
        if "mask_logits" in outputs:
            masks, classes = outputs["mask_logits"][None], outputs["mask_class_logits"][None]
            segmentation = SegmentationOutputs(masks, classes, locations=torch.zeros(0, 1, 0, 4))
        logits, codes = outputs["class_logits"][None], outputs["box_codes"][None]
        return self.form.model_outputs(ModelOutputs(outputs["bev"], logits, codes, segmentation), outputs)

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
