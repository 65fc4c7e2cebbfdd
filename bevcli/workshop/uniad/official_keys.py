"""Key names of the released weights files of UniAD, and ours."""

from bevcli.model.temporal_model import OfficialNames, Renames

# Keys without effect at inference.
_UNUSED = (
    r"^(pts_bbox_head\.(past_traj_reg_branches|query_embedding|transformer\.reference_points)\.|criterion\.|bbox_size_fc\."
    r"|seg_head\.(bev_embedding|reg_branches2|cls_thing_branches|cls_stuff_branches|cls_branches\.[0-4])\."
    r"|seg_head\.(things|stuff)_mask_head\.blocks\.\d+\.attn\.linear)"
)

_RENAMES: Renames = (
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
)

# The file of the first stage has its own object queries at the top level, beside those of BEVFormer.
OFFICIAL_NAMES = OfficialNames(r"^(query_embedding|memory_bank|query_interact|seg_head)\.", _RENAMES, _UNUSED)
