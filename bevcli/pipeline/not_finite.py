"""Finds NaN and infinity in what a model computes, and the module where they begin."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass

import torch
from torch import Tensor, nn


def origin(model: nn.Module, step: Callable[[], object]) -> str:
    """Where numbers stop being finite: an input, or the first module whose output has NaN or infinity.

    Args:
        model: the model that the step is made with.
        step: makes the step once more; every module is checked meanwhile.
    """
    found: list[str] = []

    def check(name: str, output: object) -> None:
        if not found and any(not _is_finite(tensor) for _, tensor in _tensors(output, "")):
            found.append(describe(name))

    def check_inputs(arguments: object) -> None:
        bad = [name for name, tensor in _tensors(arguments, "history") if not _is_finite(tensor)]
        if bad and not found:
            found.append(f"input {bad[0]}")

    def watch(name: str, module: nn.Module) -> torch.utils.hooks.RemovableHandle:
        return module.register_forward_hook(lambda module, arguments, output: check(name, output))

    hooks = [watch(name, module) for name, module in model.named_modules() if name]
    hooks.append(model.register_forward_pre_hook(lambda module, arguments: check_inputs(arguments)))
    try:
        step()
    finally:
        for hook in hooks:
            hook.remove()
    return found[0] if found else "the whole model"


def describe(name: str) -> str:
    """A module's name with the part of the paper's figure: "encoder layer 3 (encoder.layers.3.norms.0)"."""
    layer = re.match(r"(encoder|decoder)\.layers\.(\d+)", name)
    part = f"{layer[1]} layer {layer[2]}" if layer else name.split(".")[0].replace("_", " ")
    return part if part == name else f"{part} ({name})"


def _tensors(value: object, name: str) -> Iterator[tuple[str, Tensor]]:
    """The tensors in lists and dataclasses, with the name of the field that holds them, `name` outside of one."""
    if isinstance(value, Tensor):
        yield name, value
    elif isinstance(value, tuple | list):
        for part in value:
            yield from _tensors(part, name)
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from _tensors(getattr(value, field.name), field.name)


def _is_finite(tensor: Tensor) -> bool:
    return not tensor.is_floating_point() or bool(torch.isfinite(tensor).all())
