"""UniAD with weights and BEV maps by a rule, as the goldens have them, and the sequence of poses for its tracker.

golden_keys_uniad.json in tests/data: the keys and shapes of the official weights that BEVFormer base does not have with
the same shape, and under "unused" those without effect at inference.
"""

import json
import re
from dataclasses import replace

import numpy as np
import original_reference as original
import torch
from numpy.typing import NDArray
from original_reference import DATA, official_shapes
from stated_rule import rule_tensor, stream

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


STEM_GAIN = 1 / 57
# Pattern of a key, then what its tensor by the common rule is multiplied with, and what is added to that. They make the
# masks of different queries differ, and let tracks begin, live and end.
_CHANGES: tuple[tuple[str, float | list[float], float | list[float]], ...] = (
    (r"pts_bbox_head\.reg_branches\.\d+\.4\.weight", [0.1, 0.1, 1, 1, 0.1, 1, 1, 1, 1, 1], 0.0),
    (r"query_interact\.linear_(pos|feat)2\.weight", 0.25, 0.0),
    (r"seg_head\.things_mask_head\.blocks\.\d+\.(attn\.proj|mlp\.fc2)\.weight", 0.1, 0.0),
    (r"seg_head\.things_mask_head\.attnen\.q\.weight", 1.5, 0.0),
    (r"seg_head\.things_mask_head\.attnen\.linear\.0\.bias", 1.0, -1.0),
    (r"seg_head\.stuff_mask_head\.attnen\.linear\.0\.bias", 1.0, 0.1),
    (r"seg_head\.cls_branches\.5\.bias", 1.0, [-2.5, -1.5, -2.0]),
)


def uniad_shapes() -> dict[str, tuple[int, ...]]:
    """Key -> shape of the official weights that inference needs."""
    file = json.loads((DATA / "golden_keys_uniad.json").read_text())
    of_base = {key: shape for key, shape in official_shapes("base").items() if key not in file["not_of_base"]}
    return of_base | {key: tuple(shape) for key, shape in file["keys"].items()}


def unused_shapes() -> dict[str, tuple[int, ...]]:
    """Key -> shape of the official weights that have no effect at inference."""
    unused = json.loads((DATA / "golden_keys_uniad.json").read_text())["unused"]
    return {key: tuple(shape) for key, shape in unused.items()}


def uniad_tensor(key: str, shape: tuple[int, ...], class_bias: float = 3.35) -> np.ndarray:
    """A tensor of a state dict, by its official key and shape. class_bias: lowers the class logits of objects."""
    tensor = rule_tensor(key, shape, STEM_GAIN)
    if re.fullmatch(r"pts_bbox_head\.cls_branches\.\d+\.6\.bias", key):
        return (tensor.astype(np.float64) - class_bias).astype(np.float32)
    for pattern, factor, offset in _CHANGES:
        if re.fullmatch(pattern, key):
            rows = np.reshape(factor, (-1, 1)) if isinstance(factor, list) else factor
            return (tensor.astype(np.float64) * rows + np.asarray(offset)).astype(np.float32)
    return tensor


def uniad_state(prefix: str = "", class_bias: float = 3.35) -> dict[str, torch.Tensor]:
    """The official weights whose keys begin with `prefix`."""
    shapes = {key: shape for key, shape in uniad_shapes().items() if key.startswith(prefix)}
    return {key: torch.from_numpy(uniad_tensor(key, shape, class_bias)) for key, shape in shapes.items()}


def rule_bev(frame: int) -> torch.Tensor:
    """(1, 40000, 256) the BEV map of a frame, for the parts after the encoder."""
    bev = 1.5 * (0.8 * _smooth("bev/base") + 0.6 * _smooth(f"bev/{frame}"))
    return torch.from_numpy(bev.astype(np.float32))[None]


def _smooth(name: str, knots: int = 14, cells: int = 200) -> NDArray[np.float64]:
    """(cells², 256): normal random numbers at knots² places, linear in between, rows first."""
    values = stream(name).standard_normal((knots, knots, 256))
    place = np.linspace(0, knots - 1, cells)
    start = np.minimum(place.astype(int), knots - 2)
    share = place - start
    values = values[start] * (1 - share)[:, None, None] + values[start + 1] * share[:, None, None]
    values = values[:, start] * (1 - share)[None, :, None] + values[:, start + 1] * share[None, :, None]
    return values.reshape(cells**2, 256)
