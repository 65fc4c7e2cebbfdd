"""The parts of a model in the paper's terms, with the shapes and the number of their parameters."""

import math
from collections import Counter
from dataclasses import dataclass

import torch

from bevcli.model.config import ModelConfig
from bevcli.model.temporal_model import build_model

Shape = tuple[int, ...]


@dataclass(frozen=True)
class ModelPart:
    """A part of the model.

    Attributes:
        name: in the paper's terms.
        modules: beginnings of the part's keys in the state dict.
        shapes: shapes of the weights with two or more axes, in the order of the state dict; biases and norms left out.
        parameters: number of learned values, biases and norms included.
    """

    name: str
    modules: tuple[str, ...]
    shapes: tuple[Shape, ...]
    parameters: int


def model_parts(config: ModelConfig) -> tuple[ModelPart, ...]:
    """All parts of a model, in the order of a frame's way through it. Every parameter belongs to exactly one part."""
    with torch.device("meta"):
        model = build_model(config)
    rest = {name: tuple(parameter.shape) for name, parameter in model.named_parameters()}
    parts = []
    named = list(model.part_names())
    others = dict.fromkeys(key.split(".")[0] for key in rest)  # the modules of a model that names no parts
    for name, *modules in [*named, *((module, module) for module in others)]:
        of_part = [rest.pop(key) for key in tuple(rest) if f"{key}.".startswith(tuple(f"{m}." for m in modules))]
        if of_part:
            shapes = tuple(shape for shape in of_part if len(shape) > 1)
            parts.append(ModelPart(name, tuple(modules), shapes, sum(map(math.prod, of_part))))
    return tuple(parts)


def describe_shapes(shapes: tuple[Shape, ...]) -> str:
    """Shapes in a few words: each one with its count, or where there are many, the number of tensors."""
    counts = Counter(shapes)
    if len(counts) > 4:
        smallest, *_, largest = sorted(counts, key=lambda shape: (math.prod(shape), shape))
        return f"{len(shapes)} tensors, {_text(smallest)} to {_text(largest)}"
    return ", ".join(_text(shape) if count == 1 else f"{count} of {_text(shape)}" for shape, count in counts.items())


def parts_as_text(model: str, parts: tuple[ModelPart, ...]) -> str:
    """A table of the parts with the shapes of their weights."""
    width = max(len(part.name) for part in parts)
    lines = [f"{f'model {model}':<{width}}  {'parameters':>12}  shapes of the weights"]
    lines += [
        f"{part.name:<{width}}  {part.parameters:>12,}  {describe_shapes(part.shapes)}".rstrip() for part in parts
    ]
    lines.append(f"{'total':<{width}}  {sum(part.parameters for part in parts):>12,}")
    return "\n".join(lines)


def _text(shape: Shape) -> str:
    return " × ".join(map(str, shape))
