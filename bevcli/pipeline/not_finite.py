"""Finds NaN and infinity in what a model computes, and the module where they begin."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import fields

import torch
from torch import Tensor, nn

from bevcli.model.bevformer import BEVFormer, BEVFormerInputs, BEVFormerOutputs


def is_finite(outputs: BEVFormerOutputs) -> bool:
    """Whether the BEV map, the class logits and the box codes are finite. Reads each number once."""
    checked = (outputs.bev, outputs.class_logits[-1], outputs.box_codes[-1])
    extremes = torch.stack([end.float() for tensor in checked for end in torch.aminmax(tensor)])
    return bool(torch.isfinite(extremes).all())


def origin(model: BEVFormer, inputs: BEVFormerInputs, history: Tensor | None) -> str:
    """Where numbers stop being finite: an input, or the first module whose output has NaN or infinity.

    Runs the step once more, with a check after every module.

    Args:
        model: the model that the step was made with.
        inputs: of the step.
        history: (1, Y·X, C), the BEV map of the previous frame, or None.
    """
    for part in fields(inputs):
        if not _all_finite([getattr(inputs, part.name)]):
            return f"input {part.name}"
    if history is not None and not _all_finite([history]):
        return "history"
    found: list[str] = []

    def check(name: str, output: object) -> None:
        if not found and not _all_finite(_tensors(output)):
            found.append(name)

    def watch(name: str, module: nn.Module) -> torch.utils.hooks.RemovableHandle:
        return module.register_forward_hook(lambda module, arguments, output: check(name, output))

    hooks = [watch(name, module) for name, module in model.named_modules() if name]
    try:
        model(inputs, history)
    finally:
        for hook in hooks:
            hook.remove()
    return describe(found[0]) if found else "the whole model"


def describe(name: str) -> str:
    """A module's name with the part of the paper's figure: "encoder layer 3 (encoder.layers.3.norms.0)"."""
    layer = re.match(r"(encoder|decoder)\.layers\.(\d+)", name)
    part = f"{layer[1]} layer {layer[2]}" if layer else name.split(".")[0].replace("_", " ")
    return part if part == name else f"{part} ({name})"


def _tensors(output: object) -> Iterable[Tensor]:
    if isinstance(output, Tensor):
        yield output
    elif isinstance(output, tuple | list):
        for part in output:
            yield from _tensors(part)


def _all_finite(tensors: Iterable[Tensor]) -> bool:
    return all(bool(torch.isfinite(tensor).all()) for tensor in tensors if tensor.is_floating_point())
