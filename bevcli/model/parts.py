"""The parts of a model in the paper's terms, with the shapes and the number of their parameters."""

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch

from bevcli.model.config import ModelConfig
from bevcli.model.network import Network
from bevcli.model.temporal_model import TemporalModel, build_model
from bevcli.registry import for_model

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
    left = {name: tuple(parameter.shape) for name, parameter in model.named_parameters()}
    parts = []
    named = list(_part_names(model))
    others = dict.fromkeys(key.split(".")[0] for key in left)  # the modules of a model that names no parts
    for name, *modules in [*named, *((module, module) for module in others)]:
        of_part = [left.pop(key) for key in tuple(left) if f"{key}.".startswith(tuple(f"{m}." for m in modules))]
        if of_part:
            shapes = tuple(shape for shape in of_part if len(shape) > 1)
            parts.append(ModelPart(name, tuple(modules), shapes, sum(map(math.prod, of_part))))
    return tuple(parts)


def _part_names(model: TemporalModel) -> Iterator[tuple[str, ...]]:
    """The name of each part, then its modules, in the order of a frame's way; a model may lack some."""
    config = model.config
    if isinstance(model, Network):
        yield "backbone: stem", "backbone.conv1", "backbone.bn1"
        for stage, name in enumerate(config.backbone.stage_names()):
            yield f"backbone: stage {stage + 1}, {name}", f"backbone.stages.{stage}"
        yield "neck (FPN)", "neck"
        yield "level embeddings", "image_tokens.level_embedding"
        yield "camera embeddings", "image_tokens.camera_embedding"
        yield "calibration embedding", "calibration_embedding"
        yield "BEV queries", "bev_queries.embedding"
        yield "position embedding, rows", "bev_queries.row_embedding"
        yield "position embedding, columns", "bev_queries.column_embedding"
        yield "can-bus MLP", "bev_queries.can_bus_embedding"
        attentions = {
            "temporal_self_attention": "temporal self-attention",
            "spatial_cross_attention": "spatial cross-attention",
        }
        yield from _layer_names("encoder", config.encoder.layers, attentions)
        for block, _ in model.named_modules():
            if re.fullmatch(r"fusion\.blocks\.\d+", block):
                yield f"fusion of the window: residual block {block.rpartition('.')[2]}", block
        yield "fusion of the window: projection and norm", "fusion.projection", "fusion.norm"
        yield "object queries (position, content)", "decoder.query_embedding"
        yield "object queries: reference points", "decoder.reference_points"
        attentions = {"self_attention": "self-attention", "cross_attention": "cross-attention to BEV"}
        yield from _layer_names("decoder", config.decoder.layers, attentions)
        yield f"detection head: {config.decoder.layers} class branches", "detection_head.class_branches"
        yield f"detection head: {config.decoder.layers} box branches", "detection_head.box_branches"
        yield "segmentation: stuff queries", "segmentation_head.stuff_queries"
        yield "segmentation: location decoder", "segmentation_head.location_decoder"
        for layer in range(config.segmentation.mask_layers):
            yield f"segmentation: mask decoder layer {layer}", f"segmentation_head.mask_layers.{layer}"
    for names in for_model("part_names", type(model)):
        yield from names


def _layer_names(part: str, layers: int, attentions: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """The parts of each layer of encoder or decoder. attentions: module -> name."""
    for layer in range(layers):
        for module, name in {**attentions, "feed_forward": "feed-forward network", "norms": "norms"}.items():
            yield f"{part} layer {layer}: {name}", f"{part}.layers.{layer}.{module}"


def describe_shapes(shapes: tuple[Shape, ...]) -> str:
    """Shapes in a few words: each one with its count, or where there are many, the number of tensors."""
    counts = Counter(shapes)
    if len(counts) > 4:
        smallest, *_, largest = sorted(counts, key=lambda shape: (math.prod(shape), shape))
        return f"{len(shapes)} tensors, {_text(smallest)} to {_text(largest)}"
    return ", ".join(_text(shape) if count == 1 else f"{count} of {_text(shape)}" for shape, count in counts.items())


def _text(shape: Shape) -> str:
    return " × ".join(map(str, shape))
