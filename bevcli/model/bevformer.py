"""BEVFormer (Li et al. 2022): cameras and ego-motion in, a BEV map and objects out."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Literal

import torch
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.attention_probe import AttentionProbe
from bevcli.model.bev_queries import BevQueries
from bevcli.model.decoder import Decoder, DecoderConfig
from bevcli.model.detection_head import DetectionHead
from bevcli.model.ego_motion_inputs import EgoMotionConfig
from bevcli.model.encoder import Encoder, EncoderConfig
from bevcli.model.fpn import FPN, FPNConfig
from bevcli.model.history_alignment import rotate_history
from bevcli.model.image_config import ImageConfig
from bevcli.model.image_tokens import ImageTokens, ImageTokensConfig
from bevcli.model.kept_result import KeptResult
from bevcli.model.pillar_projection import PillarHits, PillarProjection, find_hits, project_pillars
from bevcli.model.resnet import ResNet, ResNetConfig
from bevcli.model.segmentation_head import SegmentationConfig, SegmentationHead, SegmentationOutputs


@dataclass(frozen=True)
class BEVFormerConfig:
    """A whole model. One TOML file says it; `bevcli.config.load_config` reads it.

    classes: of the objects, in the order of the scores.
    cameras: the names that the camera embeddings belong to, in their order.
    rate_hz: frames a second that the model was trained on.
    max_gap_s: a longer time between two frames starts the history anew.
    channels: of every token and query, C.
    heads: what the BEV map is read by; "segmentation" adds the head that `segmentation` configures.
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

    images: (B, N, 3, H, W) normalised, padded.
    image_from_bev: (B, N, 4, 4) float32, bev metres -> network-input pixels (rows u·d, v·d, d, 1).
    camera_index: (N,) int64, which camera embedding each image takes.
    has_image: (B, N) bool; a camera without an image is seen by no BEV cell.
    can_bus: (B, 18) float32, after the differencing.
    shift: (B, 2) float32, history shift (x, y) in normalised BEV coordinates; zero without history.
    rotation_deg: (B,) float32, rotation of the history map.
    """

    images: Tensor
    image_from_bev: Tensor
    camera_index: Tensor
    has_image: Tensor
    can_bus: Tensor
    shift: Tensor
    rotation_deg: Tensor

    def to(self, device: torch.device) -> BEVFormerInputs:
        """The same on a device."""
        tensors = (getattr(self, part.name) for part in fields(self))
        return BEVFormerInputs(*(tensor.to(device, non_blocking=True) for tensor in tensors))


@dataclass(frozen=True)
class BEVFormerOutputs:
    """bev: (B, Y·X, C) the BEV map, the next frame's history.

    class_logits: (L, B, Q, classes), one a decoder layer.
    box_codes: (L, B, Q, 10) cx, cy, log w, log l, cz, log h, sin, cos, vx, vy; centres in metres, bev frame.
    segmentation: of the segmentation head, None without one.
    """

    bev: Tensor
    class_logits: Tensor
    box_codes: Tensor
    segmentation: SegmentationOutputs | None = None


class BEVFormer(nn.Module):
    """The whole model; its parts in the order of the paper's figure 2.

    prepared: whether this is `prepare_for_inference`'s, which says itself what is computed in which precision.
    """

    pillars: Tensor
    prepared: bool = False

    def __init__(self, config: BEVFormerConfig) -> None:
        super().__init__()
        self.config = config
        grid, channels, levels = config.bev_grid, config.channels, config.neck.levels
        bev_shape = (grid.rows, grid.columns)
        self.backbone = ResNet(config.backbone)
        self.neck = FPN(config.backbone.output_channels(), channels, config.neck)
        self.image_tokens = ImageTokens(len(config.cameras), channels, config.image_tokens)
        self.bev_queries = BevQueries(grid, channels, config.ego_motion.can_bus)
        self.encoder = Encoder(config.encoder, channels, levels, grid, config.ego_motion.history_shift)
        self.decoder = Decoder(config.decoder, channels, bev_shape)
        self.detection_head = DetectionHead(config.decoder.layers, channels, len(config.classes), grid)
        wanted = "segmentation" in config.heads
        self.segmentation_head = SegmentationHead(config.segmentation, channels, bev_shape) if wanted else None
        pillars = torch.as_tensor(grid.pillars(), dtype=torch.float32).flatten(0, 1)  # (Y·X, Z, 3)
        self.register_buffer("pillars", pillars, persistent=False)
        self._kept_hits = KeptResult[PillarHits]()

    def forward(
        self, inputs: BEVFormerInputs, history: Tensor | None = None, probe: AttentionProbe | None = None
    ) -> BEVFormerOutputs:
        """One step. history: (B, Y·X, C), the BEV map of the previous frame, or None at the start of a scene.

        probe: filled with what one encoder layer looked at.
        """
        bev = self.bev_map(inputs, history, probe)
        # Boxes are refined in steps finer than half precision can tell.
        with torch.autocast(bev.device.type, enabled=False):
            class_logits, box_codes = self.decoder(bev.float(), self.detection_head)
            segmentation = None
            if self.segmentation_head is not None:
                segmentation = self.segmentation_head(bev.float(), self.bev_queries.position())
        return BEVFormerOutputs(bev, class_logits, box_codes, segmentation)

    def bev_map(self, inputs: BEVFormerInputs, history: Tensor | None, probe: AttentionProbe | None = None) -> Tensor:
        """The first half of `forward`: the BEV map (B, Y·X, C), before any head reads it."""
        maps = self.neck(self.backbone(inputs.images.flatten(0, 1)))
        return self.encoder(
            self.bev_queries(inputs.can_bus),
            self.bev_queries.position(),
            self.image_tokens(maps, inputs.camera_index),
            self._hits(inputs),
            None if history is None else self.align_history(history, inputs.rotation_deg),
            inputs.shift,
            probe,
        )

    def _hits(self, inputs: BEVFormerInputs) -> PillarHits:
        """Which cells attend in which cameras; a prepared model keeps it while calibration and poses stay."""
        if not self.prepared:
            return find_hits(self.project_pillars(inputs))
        size = torch.tensor(inputs.images.shape[-2:])
        seen_from = (inputs.image_from_bev, inputs.has_image, size)
        return self._kept_hits(lambda: find_hits(self.project_pillars(inputs)), *seen_from)

    def project_pillars(self, inputs: BEVFormerInputs) -> PillarProjection:
        """Where the pillars appear in the cameras of these inputs, and where they are visible."""
        image_size = (inputs.images.shape[-2], inputs.images.shape[-1])
        return project_pillars(inputs.image_from_bev, self.pillars, image_size, inputs.has_image)

    def align_history(self, history: Tensor, rotation_deg: Tensor) -> Tensor:
        """The history map (B, Y·X, C), turned by rotation_deg (B,)."""
        center = self.config.ego_motion.history_rotation_center
        return rotate_history(history, rotation_deg, self.config.bev_grid, center)
