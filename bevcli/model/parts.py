"""The parts of a model in the paper's terms, with the shapes and the number of their parameters."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import torch

from bevcli.model.bevformer import BEVFormerConfig
from bevcli.model.bevformer_v2 import BEVFormerV2Config
from bevcli.model.build import build_model

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


def model_parts(config: BEVFormerConfig) -> tuple[ModelPart, ...]:
    """All parts of a model, in the order of a frame's way through it. Every parameter belongs to exactly one part."""
    with torch.device("meta"):
        model = build_model(config)
    left = {name: tuple(parameter.shape) for name, parameter in model.named_parameters()}
    parts = []
    for name, *modules in _names_and_modules(config):
        found = [left.pop(key) for key in tuple(left) if f"{key}.".startswith(tuple(f"{m}." for m in modules))]
        if found:
            shapes = tuple(shape for shape in found if len(shape) > 1)
            parts.append(ModelPart(name, tuple(modules), shapes, sum(map(math.prod, found))))
    assert not left, f"parameters without a part: {', '.join(left)}"
    return tuple(parts)


def describe_shapes(shapes: tuple[Shape, ...]) -> str:
    """Shapes in a few words: each one with its count, or where there are many, the number of tensors."""
    counts = Counter(shapes)
    if len(counts) > 4:
        return f"{len(shapes)} tensors, {_text(min(counts, key=_size))} to {_text(max(counts, key=_size))}"
    return ", ".join(_text(shape) if count == 1 else f"{count} of {_text(shape)}" for shape, count in counts.items())


def _names_and_modules(config: BEVFormerConfig) -> Iterator[tuple[str, ...]]:
    """The name of each part, then its modules; this model may lack a part."""
    yield "backbone: stem", "backbone.conv1", "backbone.bn1"
    for stage, blocks in enumerate(config.backbone.blocks):
        kind = "deformable bottleneck" if stage + 1 in config.backbone.deformable_stages else "bottleneck"
        yield f"backbone: stage {stage + 1}, {blocks} {kind}{'s' * (blocks > 1)}", f"backbone.stages.{stage}"
    yield "neck (FPN)", "neck"
    yield "level embeddings", "image_tokens.level_embedding"
    yield "camera embeddings", "image_tokens.camera_embedding"
    yield "calibration embedding", "calibration_embedding"
    yield "BEV queries", "bev_queries.embedding"
    yield "position embedding, rows", "bev_queries.row_embedding"
    yield "position embedding, columns", "bev_queries.column_embedding"
    yield "can-bus MLP", "bev_queries.can_bus_embedding"
    for layer in range(config.encoder.layers):
        prefix = f"encoder.layers.{layer}"
        yield f"encoder layer {layer}: temporal self-attention", f"{prefix}.temporal_self_attention"
        yield f"encoder layer {layer}: spatial cross-attention", f"{prefix}.spatial_cross_attention"
        yield f"encoder layer {layer}: feed-forward network", f"{prefix}.feed_forward"
        yield f"encoder layer {layer}: norms", f"{prefix}.norms"
    if isinstance(config, BEVFormerV2Config):
        for block in range(config.fusion.blocks):
            yield f"fusion of the window: residual block {block}", f"fusion.blocks.{block}"
        yield "fusion of the window: projection and norm", "fusion.projection", "fusion.norm"
    yield "object queries (position, content)", "decoder.query_embedding"
    yield "object queries: reference points", "decoder.reference_points"
    for layer in range(config.decoder.layers):
        prefix = f"decoder.layers.{layer}"
        yield f"decoder layer {layer}: self-attention", f"{prefix}.self_attention"
        yield f"decoder layer {layer}: cross-attention to BEV", f"{prefix}.cross_attention"
        yield f"decoder layer {layer}: feed-forward network", f"{prefix}.feed_forward"
        yield f"decoder layer {layer}: norms", f"{prefix}.norms"
    yield f"detection head: {config.decoder.layers} class branches", "detection_head.class_branches"
    yield f"detection head: {config.decoder.layers} box branches", "detection_head.box_branches"
    yield "tracks: memory bank", "memory_bank"
    yield "tracks: query interaction", "query_interaction"
    yield "segmentation: stuff queries", "segmentation_head.stuff_queries"
    yield "segmentation: location decoder", "segmentation_head.location_decoder"
    for layer in range(config.segmentation.mask_layers):
        yield f"segmentation: mask decoder layer {layer}", f"segmentation_head.mask_layers.{layer}"
    yield "map head: encoder", "map_head.encoder"
    yield "map head: location decoder", "map_head.location_decoder"
    yield "map head: class branch", "map_head.class_branch"
    yield "map head: stuff queries", "map_head.stuff_queries"
    yield "map head: mask decoder of things", "map_head.thing_masks"
    yield "map head: mask decoder of stuff", "map_head.stuff_masks"


def _size(shape: Shape) -> tuple[int, Shape]:
    return math.prod(shape), shape


def _text(shape: Shape) -> str:
    return " × ".join(map(str, shape))
