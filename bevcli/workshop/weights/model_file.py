"""The model file of weights that fit a known model but for its classes, parts of a model, other files of weights."""

import contextlib
import json
import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors.torch
import torch

from bevcli.checkpoints import Checkpoint, difference, expected_state, read_checkpoint
from bevcli.config import as_toml, config_of_table, load_config, read_model_file
from bevcli.errors import OutputError, WeightsError
from bevcli.model.config import ModelConfig
from bevcli.model.temporal_model import build_model
from bevcli.options import gather
from bevcli.printing import counted
from bevcli.workshop.weights import ModelFileOptions
from bevcli.writing import check_output, write_whole


def model_file_for(
    weights: str | Path, out: str | Path, options: ModelFileOptions | None = None, **changes: Any
) -> tuple[ModelConfig, str]:
    """Write the model file of weights that fit a known model but for the number or names of its classes.

    Args:
        weights: a .pth or a .safetensors.
        out: the FILE.toml to write; its name is that of the model.
        options: see `ModelFileOptions`.
        changes: options as keywords: `classes` and `force`.

    Returns its configuration, and the name of the known model.

    Raises:
        WeightsError: the weights cannot be read, differ in more than the classes, or do not name these.
        OutputError: the file exists, has another ending, or cannot be written.
        ConfigError: a name is no name of a class, or stands there twice.
    """
    file_options = gather(ModelFileOptions, options, changes)
    path, checkpoint = Path(out), read_checkpoint(Path(weights))
    if path.suffix != ".toml":
        raise OutputError(f"{path}: expected a file name that ends in .toml")
    if path.exists() and not file_options.force:
        raise OutputError(
            f"{path}: already exists; choose another name, or pass `force=True` (`--force`) to overwrite it"
        )
    model = checkpoint.nearest
    names = file_options.classes
    with contextlib.suppress(ValueError):  # else as the metadata of the weights name them
        stated = json.loads(checkpoint.facts.get("classes", "[]"))
        names = names or (tuple(map(str, stated)) if isinstance(stated, list) else ())
    model_config = load_config(model)
    count = len(model_config.classes) if checkpoint.models else checkpoint.own_classes
    if count is None:
        other = difference(checkpoint.state, expected_state(model_config), len(model_config.classes))
        raise WeightsError(f"{weights}: differs from {model}, the nearest known model, in more than classes: {other}")
    if len(names) != count:
        found = counted(len(names), "names") if names else "none"
        raise WeightsError(
            f"{weights}: has {counted(count, 'classes')}: pass their names in the order of the training as "
            f"`classes` (`--classes NAME,NAME`) (found {found})"
        )
    contents = read_model_file(model)[0] | {"name": path.stem, "classes": list(names)}
    settings = contents.get("class_settings", {})
    contents["class_settings"] = {name: settings[name] for name in names if name in settings}
    config = config_of_table(contents, str(path))
    text = f"# {model} with other classes, for the weights {Path(weights).name}.\n{as_toml(contents)}"
    write_whole(path, text.encode())
    return config, model


Shape = tuple[int, ...]


@dataclass(frozen=True)
class ModelPart:
    """A part of the model."""

    name: str  # in the paper's terms
    modules: tuple[str, ...]  # beginnings of the part's keys in the state dict
    shapes: tuple[Shape, ...]  # of weights with two or more axes, as in the state dict; without biases and norms
    parameters: int  # number of learned values, biases and norms included


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


def convert(source: Path, destination: Path) -> Checkpoint:
    """Writes a weights file as .safetensors with our key names; returns what it then contains.

    Raises WeightsError where the file fits none of the known models.
    """
    checkpoint = read_checkpoint(source)
    if not checkpoint.models:
        raise WeightsError(f"{source}: {checkpoint.misfit}")
    if destination.suffix != ".safetensors":
        raise WeightsError(f"{destination}: expected a file name that ends in .safetensors")
    tensors = {key: tensor.contiguous() for key, tensor in checkpoint.state.items()}
    check_output(destination, source)
    write_whole(destination, safetensors.torch.save(tensors, {**checkpoint.facts, "model": checkpoint.models[0]}))
    return read_checkpoint(destination)
