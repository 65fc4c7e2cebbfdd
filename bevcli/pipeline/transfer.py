"""Between CPU and GPU: images go up while the model computes, results come back with one wait."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from bevcli.model.bevformer import BEVFormerOutputs
from bevcli.model.segmentation import SegmentationOutputs
from bevcli.model.uniad import UniADOutputs
from bevcli.model.upload import upload
from bevcli.pipeline.preprocess import PreparedFrame


class ImageUploader:
    """Uploads the images of frames to a CUDA GPU on a stream of its own. Does nothing for other devices.

    The thread that reads frames ahead calls it; this thread waits for the copy, and the model does not.
    """

    def __init__(self, device: torch.device) -> None:
        """To call in the thread that runs the model."""
        self._device = device
        on_gpu = device.type == "cuda"
        self._stream = torch.cuda.Stream(device) if on_gpu else None
        self._of_model = torch.cuda.current_stream(device) if on_gpu else None

    def __call__(self, prepared: PreparedFrame) -> PreparedFrame:
        """The frame with its images on the device."""
        if self._stream is None or self._of_model is None:
            return prepared
        with torch.cuda.stream(self._stream):
            images = upload(prepared.images, self._device)
        # The allocator must not give the memory away while the model's stream may still read it.
        images.record_stream(self._of_model)
        self._stream.synchronize()
        return replace(prepared, images=images)


def read_back(outputs: BEVFormerOutputs, images: Tensor) -> tuple[BEVFormerOutputs, bool]:
    """The last layers' outputs on the CPU, and whether the BEV map, the class logits and the box codes are finite.

    All copies from a CUDA GPU share one wait. The BEV map stays on its device, and so does everything of a UniAD.

    On a CPU the input images must be finite too: the ReLU of oneDNN turns NaN into zero, so NaN in the images may not
    reach the outputs. Weights are checked when they are read and when they are prepared. What is not seen: numbers
    inside of the backbone that grow beyond the range of their type and that ReLU then turns into zeros.
    """
    logits, codes = outputs.class_logits[-1:], outputs.box_codes[-1:]
    checked = [outputs.bev, logits, codes, *([images] if outputs.bev.device.type == "cpu" else [])]
    extremes = torch.stack([end.float() for x in checked for end in _extremes(x)])
    if isinstance(outputs, UniADOutputs):
        return outputs, bool(torch.isfinite(extremes).all())
    found = [logits, codes, extremes]
    segmentation = outputs.segmentation
    if segmentation is not None:
        found += [segmentation.mask_logits[-1:], segmentation.class_logits[-1:], segmentation.locations[-1:]]
    logits, codes, extremes, *masks = _on_cpu(found)
    on_cpu = BEVFormerOutputs(outputs.bev, logits, codes, SegmentationOutputs(*masks) if masks else None)
    return on_cpu, bool(torch.isfinite(extremes).all())


def _extremes(tensor: Tensor) -> tuple[Tensor, Tensor]:
    """The smallest and the largest number; NaN where any is NaN."""
    if tensor.device.type == "mps":  # has no aminmax
        return tensor.amin(), tensor.amax()
    return torch.aminmax(tensor)


def _on_cpu(tensors: list[Tensor]) -> list[Tensor]:
    """The tensors on the CPU, after one wait for a CUDA GPU."""
    device = tensors[0].device
    if device.type != "cuda":
        return [tensor.cpu() for tensor in tensors]
    copies = [torch.empty(x.shape, dtype=x.dtype, pin_memory=True).copy_(x, non_blocking=True) for x in tensors]
    torch.cuda.current_stream(device).synchronize()
    return copies
