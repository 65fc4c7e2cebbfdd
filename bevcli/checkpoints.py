"""Files of weights: the official .pth and our .safetensors, to the state dict of our model."""

from __future__ import annotations

import pickle
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from bevcli.config import known_models, load_config
from bevcli.errors import WeightsError
from bevcli.model.bevformer import BEVFormer, BEVFormerConfig

OFFICIAL_PREFIXES = ("img_backbone.", "img_neck.", "pts_bbox_head.")

# The official names' patterns and ours. One rule after the other is applied to every key.
_RENAMES = (
    (r"^img_backbone\.layer(\d)\.", lambda m: f"backbone.stages.{int(m[1]) - 1}."),
    (r"^img_backbone\.", "backbone."),
    (r"\.conv_offset\.", ".offset_and_mask."),
    (r"^img_neck\.lateral_convs\.(\d)\.conv\.", r"neck.lateral.\1."),
    (r"^pts_bbox_head\.positional_encoding\.row_embed\.weight$", "bev_queries.row_embedding"),
    (r"^pts_bbox_head\.positional_encoding\.col_embed\.weight$", "bev_queries.column_embedding"),
    (r"^pts_bbox_head\.bev_embedding\.weight$", "bev_queries.embedding"),
    (r"^pts_bbox_head\.transformer\.level_embeds$", "image_tokens.level_embedding"),
    (r"^pts_bbox_head\.transformer\.cams_embeds$", "image_tokens.camera_embedding"),
    (r"^pts_bbox_head\.transformer\.can_bus_mlp\.norm\.", "bev_queries.can_bus_embedding.4."),
    (r"^pts_bbox_head\.transformer\.can_bus_mlp\.", "bev_queries.can_bus_embedding."),
    (r"^pts_bbox_head\.query_embedding\.weight$", "decoder.query_embedding"),
    (r"^pts_bbox_head\.transformer\.reference_points\.", "decoder.reference_points."),
    (r"^pts_bbox_head\.cls_branches\.", "detection_head.class_branches."),
    (r"^pts_bbox_head\.reg_branches\.", "detection_head.box_branches."),
    (r"^pts_bbox_head\.transformer\.encoder\.", "encoder."),
    (r"^pts_bbox_head\.transformer\.decoder\.", "decoder."),
    (r"^(encoder\..*)\.attentions\.0\.", r"\1.temporal_self_attention.attention."),
    (r"^(encoder\..*)\.attentions\.1\.deformable_attention\.", r"\1.spatial_cross_attention.attention."),
    (r"^(encoder\..*)\.attentions\.1\.output_proj\.", r"\1.spatial_cross_attention.attention.output_proj."),
    (r"^(decoder\..*)\.attentions\.0\.attn\.", r"\1.self_attention."),
    (r"^(decoder\..*)\.attentions\.1\.", r"\1.cross_attention."),
    (r"\.value_proj\.", ".value_projection."),
    (r"\.output_proj\.", ".output_projection."),
    (r"\.ffns\.0\.layers\.0\.0\.", ".feed_forward.expand."),
    (r"\.ffns\.0\.layers\.1\.", ".feed_forward.reduce."),
)

# Held by the official files, used in training only.
_TRAINING_ONLY = ("pts_bbox_head.code_weights",)


@dataclass(frozen=True)
class KeyReport:
    """How a state dict differs from what a model needs; all empty when it fits.

    misshapen: lines "key: expected (…), found (…)".
    """

    missing: tuple[str, ...]
    unexpected: tuple[str, ...]
    misshapen: tuple[str, ...]

    @property
    def fits(self) -> bool:
        """Whether nothing differs."""
        return not (self.missing or self.unexpected or self.misshapen)

    def describe(self) -> str:
        """Every differing key, on one line."""
        parts = [("missing", self.missing), ("unexpected", self.unexpected), ("misshapen", self.misshapen)]
        return "; ".join(f"{len(keys)} {name}: {', '.join(keys)}" for name, keys in parts if keys)


@dataclass(frozen=True)
class Checkpoint:
    """A file of weights, read. state: under our names. official: whether the file uses the original's names.

    facts: what the file says about itself, such as its epoch.
    """

    path: Path
    state: Mapping[str, Tensor]
    official: bool
    facts: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class CheckpointSummary:
    """What a file of weights is.

    models: those of ours that it fits. parameters: how many numbers it holds, running statistics included.
    """

    path: Path
    models: tuple[str, ...]
    official: bool
    tensors: int
    parameters: int
    file_bytes: int
    facts: Mapping[str, str]


def load_weights(path: Path, model: BEVFormer) -> Checkpoint:
    """Loads a file of weights into a model, in place; every key must be there, none more, all of the right shape.

    Raises WeightsError, naming all keys that differ and the known models that the file would fit.
    """
    checkpoint = read_checkpoint(path)
    report = compare(checkpoint.state, model.state_dict())
    if not report.fits:
        models = fitting_models(checkpoint.state)
        fits = f"the file fits model {' or '.join(models)}" if models else "it fits none of the known models"
        raise WeightsError(f"{path}: is not for model {model.config.name}, {fits}; {report.describe()}")
    model.load_state_dict(dict(checkpoint.state))
    return checkpoint


def convert(source: Path, destination: Path) -> CheckpointSummary:
    """Writes a file of weights as .safetensors under our names, once it fits one of the known models."""
    checkpoint = read_checkpoint(source)
    models = fitting_models(checkpoint.state)
    if not models:
        raise WeightsError(f"{source}: fits none of the known models ({', '.join(known_models())})")
    if destination.suffix != ".safetensors":
        raise WeightsError(f"{destination}: expected a name that ends in .safetensors")
    tensors = {key: tensor.contiguous() for key, tensor in checkpoint.state.items()}
    safetensors.torch.save_file(tensors, destination, {**checkpoint.facts, "model": models[0]})
    return inspect(destination)


def inspect(path: Path) -> CheckpointSummary:
    """What a file of weights is."""
    checkpoint = read_checkpoint(path)
    return CheckpointSummary(
        path=path,
        models=fitting_models(checkpoint.state),
        official=checkpoint.official,
        tensors=len(checkpoint.state),
        parameters=sum(tensor.numel() for tensor in checkpoint.state.values()),
        file_bytes=path.stat().st_size,
        facts=checkpoint.facts,
    )


def read_checkpoint(path: Path) -> Checkpoint:
    """Reads an official .pth or a .safetensors, official keys or ours. Nothing but tensors is unpickled."""
    if not path.is_file():
        raise WeightsError(f"{path}: no such file of weights")
    state, facts = _read_safetensors(path) if path.suffix == ".safetensors" else _read_pth(path)
    official = any(key.startswith(OFFICIAL_PREFIXES) for key in state)
    return Checkpoint(path, from_official(state) if official else state, official, facts)


def from_official(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The original's state dict under our names. Keys that no rule knows stay as they are, and so are unexpected."""
    first_extra = sum(key.startswith("img_neck.lateral_convs.") and key.endswith(".weight") for key in state)
    return {_our_name(key, first_extra): tensor for key, tensor in state.items() if key not in _TRAINING_ONLY}


def compare(state: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> KeyReport:
    """Which keys of a state dict are missing, unexpected or misshapen against a model's."""
    shapes = {key: tuple(tensor.shape) for key, tensor in expected.items()}
    found = {key: tuple(tensor.shape) for key, tensor in state.items()}
    return KeyReport(
        missing=tuple(key for key in shapes if key not in found),
        unexpected=tuple(key for key in found if key not in shapes),
        misshapen=tuple(
            f"{key}: expected {shapes[key]}, found {found[key]}"
            for key in shapes
            if key in found and shapes[key] != found[key]
        ),
    )


def fitting_models(state: Mapping[str, Tensor]) -> tuple[str, ...]:
    """The known models that a state dict fits."""
    return tuple(name for name in known_models() if compare(state, expected_state(load_config(name))).fits)


def expected_state(config: BEVFormerConfig) -> dict[str, Tensor]:
    """The state dict that a model needs, as tensors without contents."""
    with torch.device("meta"):
        return BEVFormer(config).state_dict()


def _our_name(key: str, first_extra: int) -> str:
    output = re.match(r"^img_neck\.fpn_convs\.(\d+)\.conv\.(weight|bias)$", key)
    if output:
        level = int(output[1])
        part = f"output.{level}" if level < first_extra else f"extra.{level - first_extra}"
        return f"neck.{part}.{output[2]}"
    for pattern, replacement in _RENAMES:
        key = re.sub(pattern, replacement, key)
    return key


def _read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            state = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
            return state, dict(file.metadata() or {})
    except safetensors.SafetensorError as error:
        raise WeightsError(f"{path}: is no safetensors file: {error}") from error


def _read_pth(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    try:
        contents = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError) as error:
        reason = str(error).split("\n")[0]
        raise WeightsError(f"{path}: is no file of weights that is safe to read: {reason}") from error
    state = contents.get("state_dict", contents) if isinstance(contents, dict) else None
    if not isinstance(state, dict) or not state or not all(isinstance(v, Tensor) for v in state.values()):
        raise WeightsError(f"{path}: holds no state dict; expected tensors by name, at the top or as state_dict")
    meta = contents.get("meta")
    facts = {} if not isinstance(meta, dict) else {k: str(meta[k]) for k in ("epoch", "iter", "time") if k in meta}
    return state, facts
