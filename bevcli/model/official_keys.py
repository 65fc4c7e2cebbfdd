"""Translates the key names of the official weights files to ours."""

from __future__ import annotations

import re
from collections.abc import Mapping

from torch import Tensor

_PREFIXES = ("img_backbone.", "img_neck.", "pts_bbox_head.")

# Pattern of the official name, and ours. All rules are applied to every key, in this order.
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
    (r"^pts_bbox_head\.transformer\.fusion\.layers\.", "fusion.blocks."),
    (r"^pts_bbox_head\.transformer\.fusion\.layer_norm\.0\.", "fusion.projection."),
    (r"^pts_bbox_head\.transformer\.fusion\.layer_norm\.1\.", "fusion.norm."),
    (r"^pts_bbox_head\.query_embedding\.weight$", "decoder.query_embedding"),
    (r"^pts_bbox_head\.transformer\.reference_points\.", "decoder.reference_points."),
    (r"^query_embedding\.weight$", "decoder.query_embedding"),
    (r"^reference_points\.", "decoder.reference_points."),
    (r"^memory_bank\.temporal_attn\.", "memory_bank.attention."),
    (r"^memory_bank\.temporal_fc1\.", "memory_bank.expand."),
    (r"^memory_bank\.temporal_fc2\.", "memory_bank.reduce."),
    (r"^memory_bank\.temporal_norm(\d)\.", lambda m: f"memory_bank.norms.{int(m[1]) - 1}."),
    (r"^memory_bank\.save_proj\.", "memory_bank.save_projection."),
    (r"^query_interact\.self_attn\.", "query_interaction.self_attention."),
    (r"^query_interact\.linear1\.", "query_interaction.feed_forward.expand."),
    (r"^query_interact\.linear2\.", "query_interaction.feed_forward.reduce."),
    (r"^query_interact\.norm1\.", "query_interaction.norm."),
    (r"^query_interact\.norm2\.", "query_interaction.feed_forward.norm."),
    (r"^query_interact\.linear_pos1\.", "query_interaction.position.expand."),
    (r"^query_interact\.linear_pos2\.", "query_interaction.position.reduce."),
    (r"^query_interact\.norm_pos\.", "query_interaction.position.norm."),
    (r"^query_interact\.linear_feat1\.", "query_interaction.content.expand."),
    (r"^query_interact\.linear_feat2\.", "query_interaction.content.reduce."),
    (r"^query_interact\.norm_feat\.", "query_interaction.content.norm."),
    (r"^pts_bbox_head\.cls_branches\.", "detection_head.class_branches."),
    (r"^pts_bbox_head\.reg_branches\.", "detection_head.box_branches."),
    (r"^pts_bbox_head\.transformer\.encoder\.", "encoder."),
    (r"^pts_bbox_head\.transformer\.decoder\.", "decoder."),
    (r"^(encoder\..*)\.attentions\.0\.", r"\1.temporal_self_attention.attention."),
    (r"^(encoder\..*)\.attentions\.1\.deformable_attention\.", r"\1.spatial_cross_attention.attention."),
    (r"^(encoder\..*)\.attentions\.1\.output_proj\.", r"\1.spatial_cross_attention.attention.output_proj."),
    (r"^(decoder\..*)\.attentions\.0\.attn\.", r"\1.self_attention."),
    (r"^(decoder\..*)\.attentions\.1\.", r"\1.cross_attention."),
    (r"^seg_head\.transformer\.level_embeds$", "map_head.encoder.level_embedding"),
    (r"^seg_head\.transformer\.encoder\.", "map_head.encoder."),
    (r"^seg_head\.transformer\.decoder\.", "map_head.location_decoder."),
    (r"^seg_head\.transformer\.reference_points\.", "map_head.location_decoder.reference_points."),
    (r"^seg_head\.query_embedding\.weight$", "map_head.location_decoder.query_embedding"),
    (r"^seg_head\.reg_branches\.", "map_head.location_decoder.location_branches."),
    (r"^seg_head\.cls_branches\.5\.", "map_head.class_branch."),
    (r"^seg_head\.stuff_query\.weight$", "map_head.stuff_queries"),
    (r"^seg_head\.things_mask_head\.", "map_head.thing_masks."),
    (r"^seg_head\.stuff_mask_head\.", "map_head.stuff_masks."),
    (r"^(map_head\.encoder\..*)\.attentions\.0\.", r"\1.self_attention."),
    (r"^(map_head\.location_decoder\..*)\.attentions\.0\.attn\.", r"\1.self_attention."),
    (r"^(map_head\.location_decoder\..*)\.attentions\.1\.", r"\1.cross_attention."),
    (r"^(map_head\.\w+_masks)\.blocks\.", r"\1.layers."),
    (r"^(map_head\.\w+_masks)\.attnen\.linear_l1\.0\.", r"\1.masks.hidden."),
    (r"^(map_head\.\w+_masks)\.attnen\.linear\.0\.", r"\1.masks.output."),
    (r"^(map_head\.\w+_masks)\.attnen\.", r"\1.masks."),
    (r"^(map_head\.\w+_masks\..*)\.head_norm1\.", r"\1.norms.0."),
    (r"^(map_head\.\w+_masks\..*)\.head_norm2\.", r"\1.norms.1."),
    (r"^(map_head\.\w+_masks\..*)\.norm3\.", r"\1.self_attention_norm."),
    (r"^(map_head\.\w+_masks\..*)\.self_attention\.qkv\.", r"\1.self_attention.in_proj_"),
    (r"^(map_head\.\w+_masks\..*)\.self_attention\.proj\.", r"\1.self_attention.out_proj."),
    (r"^(map_head\.\w+_masks\..*)\.attn\.proj\.", r"\1.output_projection."),
    (r"^(map_head\.\w+_masks\..*)\.attn\.", r"\1."),
    (r"^(map_head\.\w+_masks\..*)\.mlp\.fc1\.", r"\1.feed_forward.expand."),
    (r"^(map_head\.\w+_masks\..*)\.mlp\.fc2\.", r"\1.feed_forward.reduce."),
    (r"^(map_head\.\w+_masks\..*)\.q\.", r"\1.query_projection."),
    (r"^(map_head\.\w+_masks\..*)\.k\.", r"\1.key_projection."),
    (r"^(map_head\.\w+_masks\..*)\.v\.", r"\1.value_projection."),
    (r"\.value_proj\.", ".value_projection."),
    (r"\.output_proj\.", ".output_projection."),
    (r"\.ffns\.0\.layers\.0\.0\.", ".feed_forward.expand."),
    (r"\.ffns\.0\.layers\.1\.", ".feed_forward.reduce."),
)

# In the official files, but used in training only.
_TRAINING_ONLY = ("pts_bbox_head.code_weights",)

# Keys of the official UniAD files without effect at inference. The file of its first stage has its own object queries
# at the top level, beside those of BEVFormer.
_UNIAD_QUERIES = "query_embedding.weight"
_UNIAD_UNUSED = re.compile(
    r"^(pts_bbox_head\.(past_traj_reg_branches|query_embedding|transformer\.reference_points)\.|criterion\.|bbox_size_fc\."
    r"|seg_head\.(bev_embedding|reg_branches2|cls_thing_branches|cls_stuff_branches|cls_branches\.[0-4])\."
    r"|seg_head\.(things|stuff)_mask_head\.blocks\.\d+\.attn\.linear)"
)


def is_official(state: Mapping[str, Tensor]) -> bool:
    """Whether a state dict uses the official key names."""
    return any(key.startswith(_PREFIXES) for key in state)


def unused_keys(state: Mapping[str, Tensor]) -> list[str]:
    """The keys of an official UniAD file that have no effect at inference; none for other files."""
    return [key for key in state if _UNIAD_UNUSED.match(key)] if _UNIAD_QUERIES in state else []


def from_official(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """An official state dict with our key names. A key that no rule matches stays unchanged."""
    unused = {*_TRAINING_ONLY, *unused_keys(state)}
    first_extra = sum(key.startswith("img_neck.lateral_convs.") and key.endswith(".weight") for key in state)
    return {_our_name(key, first_extra): tensor for key, tensor in state.items() if key not in unused}


def _our_name(key: str, first_extra: int) -> str:
    output = re.match(r"^img_neck\.fpn_convs\.(\d+)\.conv\.(weight|bias)$", key)
    if output:
        level = int(output[1])
        part = f"output.{level}" if level < first_extra else f"extra.{level - first_extra}"
        return f"neck.{part}.{output[2]}"
    for pattern, replacement in _RENAMES:
        key = re.sub(pattern, replacement, key)
    return key
