"""Translates the key names of the official weights files to ours."""

import re
from collections.abc import Mapping

from torch import Tensor

from bevcli.model.temporal_model import OfficialNames, Renames
from bevcli.registry import entries, load

# Of the parts that models share. All rules are applied to every key, in their order, after those of the model.
_RENAMES: Renames = (
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

# In the official files, but used in training only: weights of the loss, and further groups of object queries.
_TRAINING_ONLY = ("pts_bbox_head.code_weights",)
_OBJECT_QUERIES = "pts_bbox_head.query_embedding.weight"
_QUERIES_OF_A_GROUP = 900


def from_official(state: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], str]:
    """An official state dict with our key names, and the parts in words that only training uses and that it lacks.

    A key that no rule matches stays unchanged.
    """
    names = _names_of(state)
    rest, unused = names.without_unused(state)
    rest, groups = _first_group(rest)
    first_extra = sum(key.startswith("img_neck.lateral_convs.") and key.endswith(".weight") for key in rest)
    renames = [*names.renames, *_RENAMES]
    ours = {_our_name(key, first_extra, renames): x for key, x in rest.items() if key not in _TRAINING_ONLY}
    return ours, " and ".join(filter(None, (unused, groups)))


def _names_of(state: Mapping[str, Tensor]) -> OfficialNames:
    """The names of the model whose mark the state dict has; shared names only where it has none."""
    for name in entries("bevcli.models"):
        names: OfficialNames = load("bevcli.models", name).official_names
        if names.mark and any(re.match(names.mark, key) for key in state):
            return names
    return OfficialNames()


def _first_group(state: dict[str, Tensor]) -> tuple[dict[str, Tensor], str]:
    """The state dict with the first group of object queries only, and the others in words."""
    queries = state.get(_OBJECT_QUERIES)
    groups, rest = (1, 0) if queries is None or queries.ndim != 2 else divmod(len(queries), _QUERIES_OF_A_GROUP)
    if queries is None or groups < 2 or rest:
        return state, ""
    first = {**state, _OBJECT_QUERIES: queries[:_QUERIES_OF_A_GROUP].clone()}
    return first, f"{groups - 1} of {groups} groups of object queries"


def _our_name(key: str, first_extra: int, renames: Renames) -> str:
    output = re.match(r"^img_neck\.fpn_convs\.(\d+)\.conv\.(weight|bias)$", key)
    if output:
        level = int(output[1])
        module = f"output.{level}" if level < first_extra else f"extra.{level - first_extra}"
        return f"neck.{module}.{output[2]}"
    for pattern, replacement in renames:
        key = re.sub(pattern, replacement, key)
    return key
