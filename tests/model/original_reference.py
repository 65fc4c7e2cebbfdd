"""Inputs and outputs of the released BEVFormer code, from files in tests/data.

golden_inputs.json: rig and poses of four frames. golden_keys.json: names and shapes of the official weights.
golden_keys_v2.json: the same of BEVFormerV2; models but the first only list what differs.
golden_tiny.npz: outputs with weights and images by the rule of stated_rule.py; the BEV maps at every 23rd cell, the
codes and logits of every 9th query.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from stated_rule import rule_image, rule_tensor

from bevcli.checkpoints import from_official
from bevcli.config import load_config
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.ego_motion import Kinematics
from bevcli.geometry.transforms import Pose, rigid, rotation_from_quaternion
from bevcli.model.bevformer import BEVFormer
from bevcli.model.config import ModelConfig
from bevcli.model.ego_motion import EgoMotionInputs, ego_motion_inputs
from bevcli.model.step import ModelInputs
from bevcli.workshop.bevformer_v2 import BEVFormerV2, BEVFormerV2Config, WindowFrame, other_bev_from_bev

DATA = Path(__file__).parents[1] / "data"
STEM_GAIN = {"tiny": 1.0}
OTHER_STEM_GAIN = 1 / 57


@cache
def frames() -> list[dict[str, Any]]:
    """The four frames; 0 to 2 are one scene, 3 is another."""
    return json.loads((DATA / "golden_inputs.json").read_text())["infos"]


def official_shapes(model: str) -> dict[str, tuple[int, ...]]:
    """Key -> shape of the official weights."""
    if model.startswith("v2-"):
        of_v2 = json.loads((DATA / "golden_keys_v2.json").read_text())
        keys = {**of_v2["v2-t1-base"], **of_v2[model]}
    else:
        keys = json.loads((DATA / "golden_keys.json").read_text())[model]
    return {key: tuple(shape) for key, shape in keys.items()}


def official_state(model: str) -> dict[str, torch.Tensor]:
    """A state dict with the official keys, its values by the rule of stated_rule.py."""
    shapes, gain = official_shapes(model), STEM_GAIN.get(model, OTHER_STEM_GAIN)
    return {key: torch.from_numpy(rule_tensor(key, shape, gain)) for key, shape in shapes.items()}


def rule_model(name: str, history_shift: str) -> BEVFormer:
    """A model with weights by the rule of stated_rule.py, in evaluation mode."""
    config = load_config(name)
    motion = replace(config.ego_motion, history_shift=history_shift)
    model = BEVFormer(replace(config, ego_motion=motion)).eval()
    model.load_state_dict(from_official(official_state(name))[0])
    return model


def rule_model_v2(name: str) -> BEVFormerV2:
    """A BEVFormerV2 with weights by the rule of stated_rule.py, in evaluation mode."""
    config = load_config(name)
    assert isinstance(config, BEVFormerV2Config)
    model = BEVFormerV2(config).eval()
    state = from_official(official_state(name))[0]
    state["decoder.query_embedding"] = state["decoder.query_embedding"][:900].clone()  # the first group
    model.load_state_dict(state)
    return model


def with_history_shift(model: BEVFormer, history_shift: str) -> BEVFormer:
    """A model with the same weights and another history_shift."""
    motion = replace(model.config.ego_motion, history_shift=history_shift)
    other = BEVFormer(replace(model.config, ego_motion=motion)).eval()
    other.load_state_dict(model.state_dict())
    return other


def image_from_bev(frame: int, config: ModelConfig) -> np.ndarray:
    """(N, 4, 4) bev metres to pixels of the network's input, by textbook formulas."""
    matrices = []
    for name in config.cameras:
        camera = frames()[frame]["cams"][name]
        bev_from_camera = np.eye(4)
        bev_from_camera[:3, :3] = camera["sensor2lidar_rotation"]
        bev_from_camera[:3, 3] = camera["sensor2lidar_translation"]
        image_from_camera = np.eye(4)
        image_from_camera[:3, :3] = camera["cam_intrinsic"]
        scale = np.diag([config.image.size[0] / 1600, config.image.size[1] / 900, 1, 1])
        scale[:2, 2] = np.negative(config.image.crop_box[:2])
        matrices.append(scale @ image_from_camera @ np.linalg.inv(bev_from_camera))
    return np.stack(matrices)


def network_image(frame: int, camera: str, config: ModelConfig) -> np.ndarray:
    """(3, H, W) normalised, resized, padded."""
    image = rule_image(frame, camera).astype(np.float32)
    if config.image.color_order == "rgb":
        image = image[..., ::-1]
    normalised = (image - np.float32(config.image.mean)) / np.float32(config.image.std)
    resized = cv2.resize(normalised, config.image.size, interpolation=cv2.INTER_LINEAR)
    left, top, right, bottom = config.image.crop_box
    cropped = resized[top:bottom, left:right]
    padded = np.pad(cropped, ((0, -cropped.shape[0] % 32), (0, -cropped.shape[1] % 32), (0, 0)))
    return padded.transpose(2, 0, 1)


def pose(frame: int) -> Pose:
    """world_from_ego of a frame."""
    info = frames()[frame]
    return Pose(np.array(info["ego2global_translation"]), np.array(info["ego2global_rotation"]))


def motion(frame: int, config: ModelConfig, *, all_frames: bool = False) -> EgoMotionInputs:
    """The ego-motion inputs of a frame. all_frames: whether frame 3 moves from frame 2, which is of another scene."""
    previous = pose(frame - 1) if frame in (1, 2) or (frame == 3 and all_frames) else None
    can_bus = np.array(frames()[frame]["can_bus"])
    sensors = can_bus[7:10], can_bus[10:13], can_bus[13:16]
    return ego_motion_inputs(pose(frame), previous, Kinematics(*sensors), config.bev_grid, config.ego_motion)


def inputs(frame: int, config: ModelConfig, *, all_frames: bool = False) -> ModelInputs:
    """The network's inputs for one of the four frames. all_frames: see `motion`."""
    moved = motion(frame, config, all_frames=all_frames)
    images = np.stack([network_image(frame, name, config) for name in config.cameras])
    return ModelInputs(
        images=torch.from_numpy(images)[None],
        image_from_bev=torch.from_numpy(image_from_bev(frame, config)).float()[None],
        camera_index=torch.arange(len(config.cameras)),
        has_image=torch.ones(1, len(config.cameras), dtype=torch.bool),
        image_sizes=torch.tensor(config.image.size, dtype=torch.float32).expand(1, len(config.cameras), 2),
        can_bus=torch.from_numpy(moved.can_bus)[None],
        shift=torch.from_numpy(moved.shift)[None],
        rotation_deg=torch.tensor([moved.rotation_deg]),
    )


def history_image_from_bev(frame: int, current: int, config: ModelConfig) -> np.ndarray:
    """(N, 4, 4) bev metres of the current frame to pixels of an earlier frame's images."""
    info = frames()[current]
    ego_from_bev = rigid(info["lidar2ego_translation"], rotation_from_quaternion(info["lidar2ego_rotation"]))
    return image_from_bev(frame, config) @ other_bev_from_bev(pose(current), pose(frame), ego_from_bev)


def window(current: int, model: BEVFormerV2) -> list[WindowFrame | None]:
    """The window of a BEVFormerV2 at one of the four frames; None for frames before the first."""
    config, count = model.config, len(model.config.cameras)
    frames_of_window: list[WindowFrame | None] = []
    for frame in (current + offset for offset in config.frames):
        if frame < 0:
            frames_of_window.append(None)
            continue
        images = torch.from_numpy(np.stack([network_image(frame, name, config) for name in config.cameras]))[None]
        matrix = image_from_bev(frame, config)
        if frame != current:
            matrix = history_image_from_bev(frame, current, config)
        features = model.image_features(images, torch.arange(count))
        has_image = torch.ones(1, count, dtype=torch.bool)
        size = (images.shape[-2], images.shape[-1])
        frames_of_window.append(WindowFrame(features, torch.from_numpy(matrix).float()[None], has_image, size))
    return frames_of_window


def match_boxes(boxes: Boxes3D, expected: np.ndarray, labels: np.ndarray, classes: Sequence[str]) -> list[int]:
    """For each expected box, the index of our box with its class and the nearest centre; the order is lost on ties."""
    distance = np.linalg.norm(expected[:, None, :3] - boxes.centers[None], axis=-1)
    other_class = np.array(classes)[labels][:, None] != boxes.classes[None]
    rows = np.where(other_class, np.inf, distance).argmin(axis=1).tolist()
    assert len(set(rows)) == len(boxes)
    return rows
