"""Key names of the released weights files of VAD, and ours."""

from bevcli.model.official_keys import OfficialNames, Renames

_RENAMES: Renames = (
    (r"^pts_bbox_head\.map_instance_embedding\.weight$", "line_decoder.line_embedding"),
    (r"^pts_bbox_head\.map_pts_embedding\.weight$", "line_decoder.point_embedding"),
    (r"^pts_bbox_head\.transformer\.map_reference_points\.", "line_decoder.reference_points."),
    (r"^pts_bbox_head\.transformer\.map_decoder\.", "line_decoder."),
    (r"^pts_bbox_head\.map_cls_branches\.", "line_decoder.class_branches."),
    (r"^pts_bbox_head\.map_reg_branches\.", "line_decoder.point_branches."),
    (r"^pts_bbox_head\.lane_encoder\.layer_seq\.lmlp_(\d)\.mlp\.", r"line_encoder.layers.\1."),
    (r"^pts_bbox_head\.motion_mode_query\.weight$", "motion_head.mode_queries"),
    (r"^pts_bbox_head\.motion_decoder\.layers\.0\.", "motion_head.agent_attention."),
    (r"^pts_bbox_head\.pos_mlp_sa\.", "motion_head.agent_position."),
    (r"^pts_bbox_head\.motion_map_decoder\.layers\.0\.", "motion_head.line_attention."),
    (r"^pts_bbox_head\.pos_mlp\.", "motion_head.line_position."),
    (r"^pts_bbox_head\.traj_branches\.0\.", "motion_head.trajectory_branch."),
    (r"^pts_bbox_head\.traj_cls_branches\.0\.", "motion_head.mode_branch."),
    (r"^pts_bbox_head\.agent_fus_mlp\.", "motion_head.agent_fusion."),
    (r"^pts_bbox_head\.ego_query\.weight$", "planner.ego_query"),
    (r"^pts_bbox_head\.ego_agent_decoder\.layers\.0\.", "planner.agent_attention."),
    (r"^pts_bbox_head\.ego_agent_pos_mlp\.", "planner.agent_position."),
    (r"^pts_bbox_head\.ego_map_decoder\.layers\.0\.", "planner.line_attention."),
    (r"^pts_bbox_head\.ego_map_pos_mlp\.", "planner.line_position."),
    (r"^pts_bbox_head\.ego_fut_decoder\.", "planner.path_branch."),
    (r"^((motion_head|planner)\..*)\.attentions\.0\.attn\.", r"\1.attention."),
)

# The weights of the loss are used in training only.
OFFICIAL_NAMES = OfficialNames(
    r"^pts_bbox_head\.map_", _RENAMES, unused=r"^pts_bbox_head\.map_code_weights$", unused_text="{first}"
)
