"""BEVFormer (Li et al. 2022): camera images and ego-motion in, a BEV map and objects out."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Literal

import torch
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.bev_queries import BevQueries
from bevcli.model.decoder import Decoder, DecoderConfig, DetectionHead
from bevcli.model.ego_motion import EgoMotionConfig, rotate_history
from bevcli.model.encoder import Encoder, EncoderConfig
from bevcli.model.fpn import FPN, FPNConfig
from bevcli.model.image_tokens import ImageTokens, ImageTokensConfig
from bevcli.model.pillar_projection import Pillars
from bevcli.model.resnet import ResNet, ResNetConfig
from bevcli.model.segmentation import SegmentationConfig, SegmentationHead, SegmentationOutputs


@dataclass(frozen=True)
class ImageConfig:
    """How an image becomes the network's input: resized, normalised in float, padded at the right and the bottom.

    Attributes:
        size: (width, height) in pixels, before padding. Images of another aspect ratio are scaled to fit inside.
        mean: of each channel, subtracted, on the scale 0 to 255 and in color_order.
        std: of each channel, the divisor, on the same scale.
        color_order: order of the channels, "rgb" or "bgr".
        pad_divisor: width and height are padded with zeros to a multiple of it.
        resize: "linear", as the published weights were trained, aliases where images shrink to less than half;
            "area" averages the pixels that fall into one.
    """

    size: tuple[int, int]
    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    color_order: Literal["rgb", "bgr"]
    pad_divisor: int = 32
    resize: Literal["linear", "area"] = "linear"

    def __post_init__(self) -> None:
        if min(self.size) < 1 or min(self.std) <= 0 or self.pad_divisor < 1:
            raise ValueError("size, std and pad_divisor must be positive")

    @property
    def padded_size(self) -> tuple[int, int]:
        """(width, height) of the network's input, pixels."""
        width, height = (-(-extent // self.pad_divisor) * self.pad_divisor for extent in self.size)
        return width, height


@dataclass(frozen=True)
class BEVFormerConfig:
    """A whole model. `bevcli.config.load_config` reads it from a TOML file.

    Attributes:
        name: of the model.
        classes: of the objects, in the order of the class logits.
        cameras: names of the camera embeddings, in their order.
        image: how images become the network's input.
        bev_grid: the cells of the BEV map and their pillars.
        rate_hz: frame rate of the training data.
        max_gap_s: after a longer time between two frames the history is dropped.
        channels: C, of all tokens and queries.
        heads: what is computed from the BEV map; "segmentation" adds the head that `segmentation` configures.
        backbone: the ResNet.
        neck: the feature pyramid network.
        image_tokens: camera and level embeddings.
        ego_motion: can-bus numbers and alignment of the history.
        encoder: the BEV encoder.
        decoder: the object decoder.
        segmentation: the segmentation head.
    """

    name: str
    classes: tuple[str, ...]
    cameras: tuple[str, ...]
    image: ImageConfig
    bev_grid: BevGrid
    rate_hz: float = 2.0
    max_gap_s: float = 2.0
    channels: int = 256
    heads: tuple[Literal["detection", "segmentation"], ...] = ("detection",)
    backbone: ResNetConfig = field(default_factory=ResNetConfig)
    neck: FPNConfig = field(default_factory=FPNConfig)
    image_tokens: ImageTokensConfig = field(default_factory=ImageTokensConfig)
    ego_motion: EgoMotionConfig = field(default_factory=EgoMotionConfig)
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)

    def __post_init__(self) -> None:
        grid, levels = self.bev_grid, self.neck.levels
        if min(grid.rows, grid.columns, grid.pillar_points) < 1:
            raise ValueError("bev_grid needs at least one row, column and pillar point")
        if any(start >= end for start, end in (grid.x_range_m, grid.y_range_m, grid.z_range_m)):
            raise ValueError("bev_grid: each range goes from a smaller to a larger number")
        if not (self.classes and self.cameras) or min(self.channels, self.rate_hz, self.max_gap_s) <= 0:
            raise ValueError("classes and cameras must not be empty, channels, rate_hz and max_gap_s must be positive")
        if "detection" not in self.heads or len(set(self.heads)) < len(self.heads):
            raise ValueError('heads must name "detection", and no head twice')
        divisors = [2, self.encoder.attention_heads, self.decoder.attention_heads]
        if "segmentation" in self.heads:
            divisors.append(self.segmentation.attention_heads)
        if any(self.channels % divisor for divisor in divisors):
            raise ValueError(f"channels is {self.channels}; it must be even and a multiple of the attention_heads")
        if self.encoder.spatial_points % grid.pillar_points:
            raise ValueError("encoder.spatial_points must be a multiple of bev_grid.pillar_points")
        if not len(self.backbone.output_stages) <= levels <= self.image_tokens.level_embeddings:
            raise ValueError(
                f"neck.levels is {levels}; expected at least the number of backbone.output_stages, "
                f"at most image_tokens.level_embeddings"
            )


@dataclass(frozen=True)
class BEVFormerInputs:
    """One step of B sequences with N cameras.

    Attributes:
        images: (B, N, 3, H, W), normalised and padded.
        image_from_bev: (B, N, 4, 4) float32, bev metres to pixels of the network's input (rows u·d, v·d, d, 1).
        camera_index: (N,) int64, the camera embedding of each image.
        has_image: (B, N) bool; a camera without an image sees no BEV cell.
        can_bus: (B, 18) float32, the translation and the change of heading since the previous frame included.
        shift: (B, 2) float32, translation of the history (x, y) in normalised BEV coordinates; zero without history.
        rotation_deg: (B,) float32, rotation of the history map.
    """

    images: Tensor
    image_from_bev: Tensor
    camera_index: Tensor
    has_image: Tensor
    can_bus: Tensor
    shift: Tensor
    rotation_deg: Tensor

    @property
    def image_size(self) -> tuple[int, int]:
        """(height, width) of the network's input, pixels."""
        return self.images.shape[-2], self.images.shape[-1]

    def to(self, device: torch.device) -> BEVFormerInputs:
        """The same inputs on a device."""
        tensors = (getattr(self, part.name) for part in fields(self))
        return BEVFormerInputs(*(tensor.to(device, non_blocking=True) for tensor in tensors))


@dataclass(frozen=True)
class BEVFormerOutputs:
    """What one step computes.

    Attributes:
        bev: (B, Y·X, C), the BEV map, which is the next frame's history.
        class_logits: (L, B, Q, classes) of the L decoder layers.
        box_codes: (L, B, Q, 10): cx, cy, log w, log l, cz, log h, sin, cos, vx, vy; centres in metres, bev frame.
        segmentation: outputs of the segmentation head, None without one.
    """

    bev: Tensor
    class_logits: Tensor
    box_codes: Tensor
    segmentation: SegmentationOutputs | None = None


class BEVFormer(nn.Module):
    """The whole model, its parts in the order of the paper's figure 2."""

    def __init__(self, config: BEVFormerConfig) -> None:
        super().__init__()
        self.config = config
        grid, channels, levels = config.bev_grid, config.channels, config.neck.levels
        bev_shape = (grid.rows, grid.columns)
        self.backbone = ResNet(config.backbone)
        self.neck = FPN(config.backbone.output_channels(), channels, config.neck)
        self.image_tokens = ImageTokens(len(config.cameras), channels, config.image_tokens)
        self.bev_queries = BevQueries(grid, channels, config.ego_motion.can_bus)
        self.pillars = Pillars(grid)
        self.encoder = Encoder(config.encoder, channels, levels, grid, config.ego_motion.history_shift)
        self.decoder = Decoder(config.decoder, channels, bev_shape)
        self.detection_head = DetectionHead(config.decoder.layers, channels, len(config.classes), grid)
        segments = "segmentation" in config.heads
        self.segmentation_head = SegmentationHead(config.segmentation, channels, bev_shape) if segments else None

    def forward(self, inputs: BEVFormerInputs, history: Tensor | None = None) -> BEVFormerOutputs:
        """One step. history: (B, Y·X, C), the BEV map of the previous frame, or None for a scene's first frame."""
        bev = self.bev_map(inputs, history)
        # In float32: half precision is too coarse for the refinement of boxes.
        with torch.autocast(bev.device.type, enabled=False):
            class_logits, box_codes = self.decoder(bev.float(), self.detection_head)
            segmentation = None
            if self.segmentation_head is not None:
                segmentation = self.segmentation_head(bev.float(), self.bev_queries.position())
        return BEVFormerOutputs(bev, class_logits, box_codes, segmentation)

    def bev_map(self, inputs: BEVFormerInputs, history: Tensor | None) -> Tensor:
        """The BEV map (B, Y·X, C): the part of `forward` before the decoder and the heads."""
        feature_maps = self.neck(self.backbone(inputs.images.flatten(0, 1)))
        return self.encoder(
            bev_query=self.bev_queries(inputs.can_bus),
            position=self.bev_queries.position(),
            image_features=self.image_tokens(feature_maps, inputs.camera_index),
            hits=self.pillars(inputs.image_from_bev, inputs.image_size, inputs.has_image),
            history=None if history is None else self.align_history(history, inputs.rotation_deg),
            shift=inputs.shift,
        )

    def align_history(self, history: Tensor, rotation_deg: Tensor) -> Tensor:
        """The history map (B, Y·X, C), rotated by rotation_deg (B,) to the current heading."""
        center = self.config.ego_motion.history_rotation_center
        return rotate_history(history, rotation_deg, self.config.bev_grid, center)
