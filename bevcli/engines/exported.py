"""An exported file in the place of a BEVFormer or a BEVFormerV2."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from bevcli.config import config_of_table
from bevcli.engines.engine import ENGINES, Engine, EngineName
from bevcli.engines.interface import METADATA
from bevcli.errors import WeightsError
from bevcli.model.bevformer import BEVFormer, BEVFormerBase, BEVFormerConfig, BEVFormerInputs, BEVFormerOutputs
from bevcli.model.bevformer_v2 import BEVFormerV2Config, WindowFrame
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.segmentation import SegmentationOutputs
from bevcli.parsing.documents import parse_json

SUFFIX = ".onnx"


@dataclass(frozen=True)
class ExportedFile:
    """What the metadata of an exported file says of its model.

    Attributes:
        config: of the model.
        contents: the contents of the model's TOML file, its table of the tracker included.
        cameras_per_cell: the number of cameras that may see one cell of the BEV map.
        untrained: whether the weights are random.
        bundled: whether the weights are those of the package.
        precision: of backbone and neck, "fp32" or "int8".
    """

    config: BEVFormerConfig
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


class ExportedModel(BEVFormerBase):
    """An exported file, run by an engine on the CPU: what those of all models share. `load_exported` makes one.

    A `Runner` takes it in the place of a model. It has no parts to look into: sampling points of the attentions and
    times of single stages are not available.
    """

    digest: Tensor

    def __init__(self, file: Path, engine: Engine, metadata: ExportedFile) -> None:
        """engine: with the file. metadata: of the file."""
        nn.Module.__init__(self)  # not the model's, which would make its parts
        self.file, self.engine, self.metadata = file, engine, metadata
        self.config = metadata.config
        with file.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").digest()
        # The only state of this module: it tells a resumed run whether the weights are the same.
        self.register_buffer("digest", torch.tensor(list(digest), dtype=torch.uint8))

    @property
    def cameras(self) -> int:
        """N, the number of cameras that the file was exported for."""
        return self.engine.input_shapes["images"][1]

    def run(self, inputs: BEVFormerInputs, others: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The outputs of the file, by name. others: its inputs beyond, or instead of, images and cameras."""
        self._check_cameras(inputs.images.shape[1])
        feed = {
            "images": raw_images(inputs.images, self.config),
            "image_from_bev": inputs.image_from_bev,
            "camera_index": inputs.camera_index,
            "has_image": inputs.has_image,
            **others,
        }
        found = self.engine({name: tensor.cpu().numpy() for name, tensor in feed.items()})
        self._check_overlap(int(found["most_cameras_per_cell"][0]))
        return {name: torch.from_numpy(value) for name, value in found.items()}

    def _check_cameras(self, count: int) -> None:
        """Raises WeightsError unless the file was exported for this number of cameras."""
        if count != self.cameras:
            raise WeightsError(
                f"{self.file}: takes {self.cameras} cameras, but the sequence has {count}: "
                f"export it with --cameras {count}"
            )

    def _check_overlap(self, most: int) -> None:
        """Raises WeightsError where more cameras see one cell than the file has slots for."""
        slots = self.metadata.cameras_per_cell
        if most > slots:
            raise WeightsError(
                f"{self.file}: takes {slots} cameras that see the same BEV cell, but the sequence has {most}: "
                f"export it with --cameras-per-cell {most}"
            )


class ExportedBEVFormer(ExportedModel, BEVFormer):
    """An exported BEVFormer."""

    def forward(self, inputs: BEVFormerInputs, history: Tensor | None = None) -> BEVFormerOutputs:
        """As `BEVFormer.forward`, for batches of one; class logits and box codes are those of the last layer."""
        grid = self.config.bev_grid
        previous = torch.zeros(1, grid.rows * grid.columns, self.config.channels) if history is None else history
        motion = {"can_bus": inputs.can_bus, "shift": inputs.shift, "rotation": inputs.rotation_deg}
        memory = {"previous_bev": previous, "use_previous": torch.tensor([history is not None])}
        return as_outputs(self.run(inputs, motion | memory))


@dataclass(frozen=True)
class ExportedWindowOutputs(BEVFormerOutputs):
    """What one step of an exported BEVFormerV2 computes.

    Attributes:
        image_features: of the current frame, for the steps of the next frames; None for a window of one frame.
    """

    image_features: FeatureMaps | None = None


class ExportedBEVFormerV2(ExportedModel):
    """An exported BEVFormerV2, whose window ends with the current frame."""

    config: BEVFormerV2Config

    def forward(self, inputs: BEVFormerInputs, earlier: Sequence[WindowFrame | None] = ()) -> ExportedWindowOutputs:
        """As `BEVFormerV2.forward`, for batches of one; class logits and box codes are those of the last layer.

        Args:
            inputs: of the current frame; the ego-motion is not read.
            earlier: the other frames of the window, in their order; None for one that does not exist.
        """
        frames = [self._absent(inputs) if frame is None else frame for frame in earlier]
        window = {
            "image_from_bev": torch.stack([*(frame.image_from_bev for frame in frames), inputs.image_from_bev], dim=1),
            "has_image": torch.stack([*(frame.has_image for frame in frames), inputs.has_image], dim=1),
        }
        if frames:
            window["previous_features"] = torch.stack([frame.image_features.tokens for frame in frames])
        found = self.run(inputs, window)
        features = FeatureMaps(found["image_features"], self.config.level_shapes) if frames else None
        return ExportedWindowOutputs(**vars(as_outputs(found)), image_features=features)

    def _absent(self, inputs: BEVFormerInputs) -> WindowFrame:
        """The place of a frame that does not exist: no camera has an image."""
        tokens = torch.zeros(self.engine.input_shapes["previous_features"][1:])
        return WindowFrame(
            image_features=FeatureMaps(tokens, self.config.level_shapes),
            image_from_bev=torch.zeros_like(inputs.image_from_bev),
            has_image=torch.zeros_like(inputs.has_image),
            image_size=inputs.image_size,
        )


def load_exported(
    file: Path, engine: EngineName, threads: int | None = None
) -> ExportedBEVFormer | ExportedBEVFormerV2:
    """Loads an exported file.

    Args:
        file: of `bevcli export-onnx` or `bevcli quantize`.
        engine: the program that runs it.
        threads: that it uses; None takes PyTorch's number.

    Raises:
        BevcliError: the engine is not installed.
        WeightsError: the file is missing, cannot be loaded, or is not of `bevcli export-onnx`.
        ConfigError: the model in its metadata is wrong.
    """
    loaded: Engine = ENGINES[engine](file, torch.get_num_threads() if threads is None else threads)
    metadata = read_metadata(loaded.metadata, file)
    kind = ExportedBEVFormerV2 if isinstance(metadata.config, BEVFormerV2Config) else ExportedBEVFormer
    return kind(file, loaded, metadata)


def raw_images(images: Tensor, config: BEVFormerConfig) -> Tensor:
    """(1, N, 3, H, W) as the model takes them -> (1, N, H, W, 3) B G R, 0 to 255, as an exported file takes them."""
    image = config.image
    pixels = images.movedim(2, -1) * torch.tensor(image.std) + torch.tensor(image.mean)
    if image.color_order == "rgb":
        pixels = pixels.flip(-1)
    return pixels.contiguous()


def as_outputs(found: Mapping[str, Tensor]) -> BEVFormerOutputs:
    """The outputs of an exported file as those of a model with one decoder layer."""
    segmentation = None
    if "mask_logits" in found:
        segmentation = SegmentationOutputs(
            found["mask_logits"][None], found["mask_class_logits"][None], torch.zeros(0, 1, 0, 4)
        )
    return BEVFormerOutputs(found["bev"], found["class_logits"][None], found["box_codes"][None], segmentation)
