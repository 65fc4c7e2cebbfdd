"""Between CPU and GPU: images go up while the model computes, results come back with one wait and are checked."""

import re
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import fields, replace

import torch
from torch import Tensor, nn

from bevcli.model.step import ModelOutputs, PreparedFrame
from bevcli.model.upload import exchanged, packed, tensors_in, unpacked, upload


def image_uploader(device: torch.device) -> Callable[[PreparedFrame], PreparedFrame]:
    """A function that gives frames their images on a device: those for a CUDA GPU are uploaded on a stream of its own.

    To call in the thread that runs the model. The thread that reads frames ahead calls the function: it waits for the
    copy, and the model does not.
    """
    if device.type != "cuda":
        return lambda prepared: prepared
    stream, of_model = torch.cuda.Stream(device), torch.cuda.current_stream(device)

    def uploaded(prepared: PreparedFrame) -> PreparedFrame:
        with torch.cuda.stream(stream):
            images = upload(prepared.images, device)
        # The allocator must not give the memory away while the model's stream may still read it.
        images.record_stream(of_model)
        stream.synchronize()
        return replace(prepared, images=images)

    return uploaded


def read_back(outputs: ModelOutputs, images: Tensor) -> tuple[ModelOutputs, bool]:
    """The last layers' outputs on the CPU, and whether the BEV map, the class logits and the box codes are finite.

    There is one copy from a CUDA GPU. What `ModelOutputs.stay_on_device` names stays there. The input images
    must be finite too: the ReLU of oneDNN, and of cuDNN, turns NaN into zero, so that it may not reach the outputs.
    Weights are checked when they are read and when they are prepared. Not seen are numbers inside of the backbone that
    grow beyond the range of their type and that ReLU then turns into zeros.
    """
    last = outputs.last_layers()
    checked = [last.bev, last.class_logits, last.box_codes, upload(images, last.bev.device)]
    sums = torch.stack([tensor.sum(dtype=torch.float32) for tensor in checked])  # NaN and infinity stay in a sum
    moved = {part.name: getattr(last, part.name) for part in fields(last) if part.name not in last.stay_on_device}
    sums, *copies = _on_cpu([sums, *(tensor for _, tensor in tensors_in(list(moved.values())))])
    source = iter(copies)
    on_cpu = replace(last, **{name: exchanged(value, source) for name, value in moved.items()})
    return on_cpu, bool(torch.isfinite(sums).all())


def _on_cpu(tensors: list[Tensor]) -> list[Tensor]:
    """The tensors on the CPU, after one wait for a CUDA GPU."""
    device = tensors[0].device
    if device.type != "cuda":
        return [tensor.cpu() for tensor in tensors]
    memory = packed(tensors)
    copy = pinned_place(memory).copy_(memory, non_blocking=True)
    torch.cuda.current_stream(device).synchronize()
    return unpacked(copy, tensors)


def pinned_place(tensor: Tensor) -> Tensor:
    """Memory for a copy of a tensor, to which a GPU writes by itself. Needs a CUDA GPU."""
    return torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)


def origin(model: nn.Module, step: Callable[[], object]) -> str:
    """The origin of NaN or infinity: an input, or the first module whose output has any.

    model: the model that the step is made with. step: makes the step once more; every module is checked meanwhile.
    """
    found: list[str] = []

    def check(value: object, place: str = "") -> None:
        tensors = [(name, tensor) for name, tensor in tensors_in(value, "history") if tensor.is_floating_point()]
        bad = [name for name, tensor in tensors if not torch.isfinite(tensor).all()]
        if bad and not found:
            found.append(place or f"input {bad[0]}")

    with ExitStack() as hooks:
        hooks.enter_context(model.register_forward_pre_hook(lambda module, arguments: check(arguments)))
        for name, module in model.named_modules():
            if name:
                hook = module.register_forward_hook(lambda *call, name=name: check(call[2], describe(name)))
                hooks.enter_context(hook)
        step()
    return found[0] if found else "the whole model"


def describe(name: str) -> str:
    """A module's name with the part of the paper's figure: "encoder layer 3 (encoder.layers.3.norms.0)"."""
    layer = re.match(r"(encoder|decoder)\.layers\.(\d+)", name)
    part = f"{layer[1]} layer {layer[2]}" if layer else name.split(".")[0].replace("_", " ")
    return part if part == name else f"{part} ({name})"
