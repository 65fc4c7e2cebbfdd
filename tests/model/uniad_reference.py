"""UniAD with weights and BEV maps by a rule, for the comparison with the released code.

The rule is that of stated_rule.py, with factors and offsets for the keys of _CHANGES, so that tracks are born, live and
die, and masks differ from query to query. golden_keys_uniad.json holds the keys that UniAD has beside those of
BEVFormer base.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import original_reference as original
import torch
from stated_rule import rule_tensor, stream

from bevcli.config import load_config
from bevcli.geometry.transforms import Array, rigid, rotation_about_z, rotation_from_quaternion
from bevcli.model.encoder import EncoderConfig
from bevcli.model.official_keys import from_official
from bevcli.model.resnet import ResNetConfig
from bevcli.model.uniad import UniAD, UniADConfig

KEYS = json.loads((original.DATA / "golden_keys_uniad.json").read_text())
MODEL_CLASS_BIAS, TRACKER_CLASS_BIAS = 3.35, 3.8  # subtracted from the class branches' last bias

# Pattern of the key, factor (a number, or one for each row), offset. Small refinements of x, y, z keep rounding
# differences from growing tenfold a frame.
_CHANGES = (
    (r"pts_bbox_head\.reg_branches\.\d+\.4\.weight", (0.1, 0.1, 1, 1, 0.1, 1, 1, 1, 1, 1), 0.0),
    (r"query_interact\.linear_(pos|feat)2\.weight", 0.25, 0.0),
    (r"seg_head\.things_mask_head\.blocks\.\d+\.(attn\.proj|mlp\.fc2)\.weight", 0.1, 0.0),
    (r"seg_head\.things_mask_head\.attnen\.q\.weight", 1.5, 0.0),
    (r"seg_head\.things_mask_head\.attnen\.linear\.0\.bias", 1.0, -1.0),
    (r"seg_head\.stuff_mask_head\.attnen\.linear\.0\.bias", 1.0, 0.1),
    (r"seg_head\.cls_branches\.5\.bias", 1.0, (-2.5, -1.5, -2.0)),
)

# The track-only sequence: frames 0 to 17 are one scene, 18 is another; a second passes before frame 6.
SCENES = "A" * 18 + "B"
SECONDS = [0.5 * frame + (0.5 if frame >= 6 else 0.0) for frame in range(19)]
BEV_SIDE, BEV_CHANNELS, BEV_NODES = 200, 256, 14


def rule_uniad_tensor(key: str, shape: tuple[int, ...], class_bias: float) -> torch.Tensor:
    """A tensor of the official state dict, by its key and shape."""
    values = rule_tensor(key, shape, original.OTHER_STEM_GAIN)
    if re.fullmatch(r"pts_bbox_head\.cls_branches\.\d+\.6\.bias", key):
        values = (values.astype(np.float64) - class_bias).astype(np.float32)
    for pattern, factor, offset in _CHANGES:
        if re.fullmatch(pattern, key):
            by_row = np.reshape(factor, (-1, 1)) if isinstance(factor, tuple) else factor
            values = (values.astype(np.float64) * by_row + np.asarray(offset)).astype(np.float32)
    return torch.from_numpy(values)


def official_keys() -> dict[str, tuple[int, ...]]:
    """Key -> shape of the official weights, without keys that our model does not have."""
    old = (
        "pts_bbox_head.query_embedding.",
        "pts_bbox_head.transformer.reference_points.",
        "pts_bbox_head.code_weights",
    )
    of_base = {key: shape for key, shape in original.official_shapes("base").items() if not key.startswith(old)}
    return of_base | {key: tuple(shape) for key, shape in KEYS["uniad-track-map"].items()}


def rule_uniad(first_frame: str = "original") -> UniAD:
    """The whole model, in evaluation mode."""
    config = load_config("uniad-track-map")
    assert isinstance(config, UniADConfig)
    with torch.device("meta"):
        keys = UniAD(config).state_dict().keys()
    model = UniAD(replace(config, ego_motion=replace(config.ego_motion, first_frame=first_frame))).eval()
    state = {key: rule_uniad_tensor(key, shape, MODEL_CLASS_BIAS) for key, shape in official_keys().items()}
    model.load_state_dict({key: tensor for key, tensor in from_official(state).items() if key in keys})
    return model


def rule_tracker() -> UniAD:
    """A UniAD whose tracker has the published size and weights by the rule; backbone, encoder and map are tiny."""
    config = load_config("uniad-track-map")
    assert isinstance(config, UniADConfig)
    tiny_map = replace(config.map_head, encoder_layers=1, location_layers=1, thing_mask_layers=1, stuff_mask_layers=1)
    backbone = ResNetConfig(blocks=(1, 1, 1, 1), width=8)
    model = UniAD(replace(config, backbone=backbone, encoder=EncoderConfig(layers=1), map_head=tiny_map)).eval()
    parts = ("query_embedding", "reference_points", "query_interact", "memory_bank", "pts_bbox_head.cls_branches")
    parts += ("pts_bbox_head.reg_branches", "pts_bbox_head.transformer.decoder")
    keys = {key: shape for key, shape in official_keys().items() if key.startswith(parts)}
    state = {key: rule_uniad_tensor(key, shape, TRACKER_CLASS_BIAS) for key, shape in keys.items()}
    _, unexpected = model.load_state_dict(from_official(state), strict=False)
    assert not unexpected
    return model


def rule_bev(frame: int) -> torch.Tensor:
    """(1, Y·X, C) BEV map of a frame of the track-only sequence: smooth, because noise would amplify rounding."""
    cells = 1.5 * (0.8 * _smooth("bev/base") + 0.6 * _smooth(f"bev/{frame}"))
    return torch.from_numpy(cells.astype(np.float32))[None]


def world_from_bev(frame: int) -> Array:
    """(4, 4) of the track-only sequence: 4 m a frame ahead, turning left by 2 degrees."""
    position = np.array([400.0, 1200.0, 0.01 * frame])
    for before in range(frame):
        yaw = np.radians(350 + 2 * before)
        position[:2] += 4 * np.cos(yaw), 4 * np.sin(yaw)
    info = original.frames()[0]
    ego_from_bev = rigid(info["lidar2ego_translation"], rotation_from_quaternion(info["lidar2ego_rotation"]))
    return rigid(position, rotation_about_z(np.radians(350 + 2 * frame))) @ ego_from_bev


def _smooth(name: str) -> np.ndarray:
    """(Y·X, C): normal numbers at 14 x 14 evenly spaced places, linear in between."""
    values = stream(name).standard_normal((BEV_NODES, BEV_NODES, BEV_CHANNELS))
    places = np.linspace(0, BEV_NODES - 1, BEV_SIDE)
    below = np.minimum(places.astype(int), BEV_NODES - 2)
    share = (places - below)[:, None, None]
    values = values[below] * (1 - share) + values[below + 1] * share
    share = share[:, 0]
    values = values[:, below] * (1 - share) + values[:, below + 1] * share
    return values.reshape(-1, BEV_CHANNELS)
