"""UniAD with weights by the rule of uniad_rule.py, and the poses of the sequence for its tracker alone."""

from dataclasses import replace

import numpy as np
import original_reference as original
import torch
from uniad_rule import uniad_shapes, uniad_tensor, unused_shapes

from bevcli.checkpoints import from_official
from bevcli.config import load_config
from bevcli.geometry.transforms import Array, rigid, rotation_about_z, rotation_from_quaternion
from bevcli.model.encoder import EncoderConfig
from bevcli.model.resnet import ResNetConfig
from bevcli.workshop.uniad.uniad import UniAD, UniADConfig

TRACKER_CLASS_BIAS = 3.8  # of golden_uniad_track_only

# The sequence for the tracker alone: frames 0 to 17 are one scene, 18 is another; a second passes before frame 6.
SCENES = "A" * 18 + "B"
SECONDS = [0.5 * frame + (0.5 if frame >= 6 else 0.0) for frame in range(19)]


def uniad_config() -> UniADConfig:
    """The published configuration."""
    config = load_config("uniad-track-map")
    assert isinstance(config, UniADConfig)
    return config


def model_shapes() -> dict[str, tuple[int, ...]]:
    """Key -> shape of the official weights that our model has.

    It has the class branches of all decoder layers, as BEVFormer; those of the first five have no effect at inference.
    """
    branches = {key: shape for key, shape in unused_shapes().items() if key.startswith("pts_bbox_head.cls_branches.")}
    return uniad_shapes() | branches


def rule_uniad(first_frame: str) -> UniAD:
    """The whole model, in evaluation mode. first_frame: of EgoMotionConfig."""
    config = uniad_config()
    model = UniAD(replace(config, ego_motion=replace(config.ego_motion, first_frame=first_frame))).eval()
    state = {key: torch.from_numpy(uniad_tensor(key, shape)) for key, shape in model_shapes().items()}
    model.load_state_dict(from_official(state)[0])
    return model


def rule_tracker() -> UniAD:
    """A UniAD whose tracker has the published size and weights by the rule; backbone, encoder and map are tiny."""
    config = uniad_config()
    tiny_map = replace(config.map_head, encoder_layers=1, location_layers=1, thing_mask_layers=1, stuff_mask_layers=1)
    backbone = ResNetConfig(blocks=(1, 1, 1, 1), width=8)
    model = UniAD(replace(config, backbone=backbone, encoder=EncoderConfig(layers=1), map_head=tiny_map)).eval()
    parts = ("query_embedding", "reference_points", "query_interact", "memory_bank", "pts_bbox_head.cls_branches")
    parts += ("pts_bbox_head.reg_branches", "pts_bbox_head.transformer.decoder")
    shapes = {key: shape for key, shape in model_shapes().items() if key.startswith(parts)}
    state = {key: torch.from_numpy(uniad_tensor(key, shape, TRACKER_CLASS_BIAS)) for key, shape in shapes.items()}
    _, unexpected = model.load_state_dict(from_official(state)[0], strict=False)
    assert not unexpected
    return model


def world_from_bev(frame: int) -> Array:
    """(4, 4) of the sequence for the tracker alone: 4 m a frame ahead, turning left by 2 degrees."""
    position = np.array([400.0, 1200.0, 0.01 * frame])
    for before in range(frame):
        yaw = np.radians(350 + 2 * before)
        position[:2] += 4 * np.cos(yaw), 4 * np.sin(yaw)
    info = original.frames()[0]
    ego_from_bev = rigid(info["lidar2ego_translation"], rotation_from_quaternion(info["lidar2ego_rotation"]))
    return rigid(position, rotation_about_z(np.radians(350 + 2 * frame))) @ ego_from_bev
