"""ONNX Runtime in the place of PyTorch: an exported file with the interface of a BEVFormer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from bevcli.engines.packages import require
from bevcli.errors import WeightsError
from bevcli.model.bevformer import BEVFormer, BEVFormerConfig, BEVFormerInputs, BEVFormerOutputs
from bevcli.model.segmentation import SegmentationOutputs


class OnnxBEVFormer(BEVFormer):
    """An exported file, run by ONNX Runtime on the CPU. A `Runner` takes it in the place of a BEVFormer.

    It has no parts to look into: stage times and the sampling points of the attentions are not available.
    """

    def __init__(self, file: Path, config: BEVFormerConfig, threads: int | None = None) -> None:
        """Loads the file.

        Args:
            file: of `bevcli export-onnx`.
            config: of the model that was exported.
            threads: that ONNX Runtime uses; None takes PyTorch's number.

        Raises:
            BevcliError: ONNX Runtime is not installed.
            WeightsError: the file is missing, cannot be loaded, or holds another model.
        """
        nn.Module.__init__(self)  # not BEVFormer's, which would make its parts
        self.config = config
        self.session = open_session(file, torch.get_num_threads() if threads is None else threads)
        self.metadata = self.session.get_modelmeta().custom_metadata_map
        found = self.metadata.get("model")
        if found != config.name:
            raise WeightsError(
                f"{file}: holds the model {found}, expected {config.name}: export that model with bevcli export-onnx"
            )
        self._names = [output.name for output in self.session.get_outputs()]

    @property
    def cameras(self) -> int:
        """N, the number of cameras that the file was exported for."""
        return int(self.session.get_inputs()[0].shape[1])

    def forward(self, inputs: BEVFormerInputs, history: Tensor | None = None) -> BEVFormerOutputs:
        """As `BEVFormer.forward`, for batches of one; class logits and box codes are those of the last layer."""
        if inputs.images.shape[1] != self.cameras:
            raise WeightsError(
                f"the exported model takes {self.cameras} cameras, but the sequence has {inputs.images.shape[1]}: "
                f"export it with --cameras {inputs.images.shape[1]}"
            )
        values = self.session.run(self._names, self._feed(inputs, history))
        found = {name: torch.from_numpy(value) for name, value in zip(self._names, values, strict=True)}
        segmentation = None
        if "mask_logits" in found:
            segmentation = SegmentationOutputs(
                found["mask_logits"][None], found["mask_class_logits"][None], torch.zeros(0, 1, 0, 4)
            )
        return BEVFormerOutputs(found["bev"], found["class_logits"][None], found["box_codes"][None], segmentation)

    def _feed(self, inputs: BEVFormerInputs, history: Tensor | None) -> dict[str, np.ndarray]:
        image, grid = self.config.image, self.config.bev_grid
        pixels = inputs.images.movedim(2, -1) * torch.tensor(image.std) + torch.tensor(image.mean)
        if image.color_order == "rgb":
            pixels = pixels.flip(-1)
        previous = torch.zeros(1, grid.rows * grid.columns, self.config.channels) if history is None else history
        tensors = {
            "images": pixels.contiguous(),
            "image_from_bev": inputs.image_from_bev,
            "camera_index": inputs.camera_index,
            "has_image": inputs.has_image,
            "can_bus": inputs.can_bus,
            "shift": inputs.shift,
            "rotation": inputs.rotation_deg,
            "previous_bev": previous,
            "use_previous": torch.tensor([history is not None]),
        }
        return {name: tensor.cpu().numpy() for name, tensor in tensors.items()}


def open_session(file: Path, threads: int) -> Any:
    """An `onnxruntime.InferenceSession` on the CPU. Raises WeightsError where the file cannot be loaded."""
    require("onnxruntime")
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3  # errors only
    try:
        return onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime has classes of its own for a missing and for a broken file
        raise WeightsError(f"{file}: ONNX Runtime cannot load it: {str(error).splitlines()[0]}") from error
