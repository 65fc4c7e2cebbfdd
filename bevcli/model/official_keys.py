"""Translates the key names of the official weights files to ours."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from bevcli.model.temporal_model import TemporalModel
from bevcli.registry import entries, load

_PREFIXES = ("img_backbone.", "img_neck.", "pts_bbox_head.")

# Pattern of the official name, and ours, of the parts that models share. All rules are applied to every key, in their
# order, after those of `TemporalModel.official_names`.
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
    (r"\.attentions\.0\.attn\.", ".self_attention."),  # of all decoders
    (r"\.attentions\.1\.", ".cross_attention."),
    (r"\.value_proj\.", ".value_projection."),
    (r"\.output_proj\.", ".output_projection."),
    (r"\.ffns\.0\.layers\.0\.0\.", ".feed_forward.expand."),
    (r"\.ffns\.0\.layers\.1\.", ".feed_forward.reduce."),
)

# In the official files, but used in training only.
_TRAINING_ONLY = ("pts_bbox_head.code_weights",)


def is_official(state: Mapping[str, Tensor]) -> bool:
    """A state dict uses the official key names."""
    return any(key.startswith(_PREFIXES) for key in state)


def from_official(state: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], str]:
    """An official state dict with our key names, and the parts in words that only training uses and that it lacks.

    A key that no rule matches stays unchanged.
    """
    left_out = []
    models: list[type[TemporalModel]] = [load("bevcli.models", name) for name in entries("bevcli.models")]
    for model in models:
        state, parts = model.without_training_parts(state)
        left_out += [parts] if parts else []
    names = [*(rule for model in models for rule in model.official_names), *_RENAMES]
    first_extra = sum(key.startswith("img_neck.lateral_convs.") and key.endswith(".weight") for key in state)
    found = {_our_name(key, first_extra, names): x for key, x in state.items() if key not in _TRAINING_ONLY}
    return found, " and ".join(left_out)


def _our_name(key: str, first_extra: int, names: Sequence[tuple[str, Any]]) -> str:
    output = re.match(r"^img_neck\.fpn_convs\.(\d+)\.conv\.(weight|bias)$", key)
    if output:
        level = int(output[1])
        part = f"output.{level}" if level < first_extra else f"extra.{level - first_extra}"
        return f"neck.{part}.{output[2]}"
    for pattern, replacement in names:
        key = re.sub(pattern, replacement, key)
    return key
