"""BEVFormer (Li et al. 2022): cameras and ego-motion in, a BEV map and objects out."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from torch import Tensor

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.decoder import DecoderConfig
from bevcli.model.ego_motion_inputs import EgoMotionConfig
from bevcli.model.encoder import EncoderConfig
from bevcli.model.fpn import FPNConfig
from bevcli.model.image_config import ImageConfig
from bevcli.model.resnet import ResNetConfig


@dataclass(frozen=True)
class BEVFormerConfig:
    """A whole model. One TOML file says it; `bevcli.config.load_config` reads it.

    classes: of the objects, in the order of the scores.
    cameras: the names that the camera embeddings belong to, in their order.
    rate_hz: frames a second that the model was trained on.
    max_gap_s: a longer time between two frames starts the history anew.
    channels: of every token and query, C.
    """

    name: str
    classes: tuple[str, ...]
    cameras: tuple[str, ...]
    image: ImageConfig
    bev_grid: BevGrid
    rate_hz: float = 2.0
    max_gap_s: float = 2.0
    channels: int = 256
    heads: tuple[Literal["detection"], ...] = ("detection",)
    backbone: ResNetConfig = field(default_factory=ResNetConfig)
    neck: FPNConfig = field(default_factory=FPNConfig)
    ego_motion: EgoMotionConfig = field(default_factory=EgoMotionConfig)
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    decoder: DecoderConfig = field(default_factory=DecoderConfig)


@dataclass(frozen=True)
class BEVFormerInputs:
    """One step of B sequences with N cameras.

    images: (B, N, 3, H, W) normalised, padded.
    image_from_bev: (B, N, 4, 4) float32, bev metres -> network-input pixels (rows u·d, v·d, d, 1).
    camera_index: (N,) int64, which camera embedding each picture takes.
    has_picture: (B, N) bool; a camera without a picture is seen by no BEV cell.
    can_bus: (B, 18) float32, after the differencing.
    shift: (B, 2) float32, history shift (x, y) in normalised BEV coordinates; zero without history.
    rotation_deg: (B,) float32, rotation of the history map.
    """

    images: Tensor
    image_from_bev: Tensor
    camera_index: Tensor
    has_picture: Tensor
    can_bus: Tensor
    shift: Tensor
    rotation_deg: Tensor


@dataclass(frozen=True)
class BEVFormerOutputs:
    """bev: (B, Y·X, C) the BEV map, the next frame's history.

    class_logits: (L, B, Q, classes), one a decoder layer.
    box_codes: (L, B, Q, 10) cx, cy, log w, log l, cz, log h, sin, cos, vx, vy; centres in metres, bev frame.
    """

    bev: Tensor
    class_logits: Tensor
    box_codes: Tensor
