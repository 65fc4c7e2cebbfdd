"""BEVFormer (Li et al. 2022): camera images and ego-motion in, a BEV map and objects out."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Literal

import torch
from torch import Tensor, nn

from bevcli.frame import MAP_CLASSES
from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.bev_queries import BevQueries
from bevcli.model.calibration_embedding import CalibrationEmbedding
from bevcli.model.decoder import Decoder, DecoderConfig, DetectionHead
from bevcli.model.deformable_attention import FeatureMaps, LevelShapes
from bevcli.model.ego_motion import EgoMotionConfig, rotate_history
from bevcli.model.encoder import Encoder, EncoderConfig
from bevcli.model.fpn import FPN, FPNConfig
from bevcli.model.image_tokens import ImageTokens, ImageTokensConfig
from bevcli.model.pillar_projection import Pillars
from bevcli.model.resnet import ResNet, ResNetConfig
from bevcli.model.segmentation import SegmentationConfig, SegmentationHead, SegmentationOutputs
from bevcli.model.upload import upload


@dataclass(frozen=True)
class ImageConfig:
    """How an image becomes the network's input: resized, cropped, normalised in float, padded at right and bottom.

    Attributes:
        size: (width, height) in pixels that an image is resized to. Images of another aspect ratio are scaled to fit
            inside.
        mean: of each channel, subtracted, on the scale 0 to 255 and in color_order.
        std: of each channel, the divisor, on the same scale.
        color_order: order of the channels, "rgb" or "bgr".
        pad_divisor: width and height are padded with zeros to a multiple of it.
        resize: "linear", as the published weights were trained, aliases where images shrink to less than half;
            "area" averages the pixels that fall into one.
        half_pixel_shift: whether projections follow the resized image exactly: it keeps the corners of the image, so
            that pixel u goes to (u + 0.5) * scale - 0.5. If false, it goes to u * scale, as the published weights were
            trained, which is 0.3 pixels off where 1600 pixels become 512.
        crop: (left, top, right, bottom) in pixels of the resized image: the part that the network sees. None for all.
        focal_px: images of wide cameras become larger than `size`: their median focal length becomes this, in pixels
            of the network's input, so that objects at the same distance have the same size for every rig
            (`bevcli.pipeline.preprocess.image_for_rig`). None: `size` holds for every rig.
        max_pixels: with `focal_px`, images become larger only as long as all images of a frame have no more pixels.
    """

    size: tuple[int, int]
    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    color_order: Literal["rgb", "bgr"]
    pad_divisor: int = 32
    resize: Literal["linear", "area"] = "linear"
    half_pixel_shift: bool = False
    crop: tuple[int, int, int, int] | None = None
    focal_px: float | None = None
    max_pixels: int | None = None

    def __post_init__(self) -> None:
        if min(self.size) < 1 or min(self.std) <= 0 or self.pad_divisor < 1:
            raise ValueError("size, std and pad_divisor must be positive")
        left, top, right, bottom = self.crop_box
        if not (0 <= left < right <= self.size[0] and 0 <= top < bottom <= self.size[1]):
            raise ValueError("crop must be left, top, right, bottom inside size, left < right and top < bottom")
        if (self.focal_px is None) != (self.max_pixels is None):
            raise ValueError("focal_px and max_pixels must be given together")
        if self.focal_px is not None and self.max_pixels is not None:
            if self.crop is not None:
                raise ValueError("crop and focal_px exclude each other: with focal_px the size depends on the rig")
            if self.focal_px <= 0 or self.max_pixels < 1:
                raise ValueError("focal_px and max_pixels must be positive")

    @property
    def crop_box(self) -> tuple[int, int, int, int]:
        """Left, top, right and bottom of the part of the resized image that the network sees, pixels."""
        return (0, 0, *self.size) if self.crop is None else self.crop

    @property
    def padded_size(self) -> tuple[int, int]:
        """(width, height) of the network's input, pixels."""
        left, top, right, bottom = self.crop_box
        width, height = (-(-extent // self.pad_divisor) * self.pad_divisor for extent in (right - left, bottom - top))
        return width, height


@dataclass(frozen=True)
class BevFrameConfig:
    """The bev frame that a model was trained in, relative to the ego frame, whose origin is on the ground.

    Attributes:
        level: whether the z axis of the bev frame must be vertical. The bev frame of every drive is then replaced by a
            level one with the same heading and origin, at the height `height_m`. If false, the drive's is used.
        height_m: height of the origin above the ground, metres; nuScenes' LIDAR_TOP has 1.84.
    """

    level: bool = False
    height_m: float = 1.84


@dataclass(frozen=True)
class TrainingRigsConfig:
    """The rigs that a model's weights were trained on. It changes no result: a drive's rig is compared with it.

    Attributes:
        cameras: smallest and largest number of cameras; 0 and 0 where the rigs are not known.
        fov_deg: smallest and largest horizontal field of view.
        height_m: smallest and largest height of a camera above the ground.
        tilt_deg: largest pitch or roll of a camera.
        cost: what other rigs were measured to cost, in words.
    """

    cameras: tuple[int, int] = (0, 0)
    fov_deg: tuple[float, float] = (0.0, 180.0)
    height_m: tuple[float, float] = (0.0, 10.0)
    tilt_deg: float = 90.0
    cost: str = ""

    @property
    def known(self) -> bool:
        """Whether the model's file states the rigs."""
        return self.cameras[1] > 0


@dataclass(frozen=True)
class BEVFormerConfig:
    """A whole model. `bevcli.config.load_config` reads it from a TOML file.

    Attributes:
        name: of the model.
        classes: of the objects, in the order of the class logits.
        cameras: names of the camera embeddings, in their order.
        image: how images become the network's input.
        bev_grid: the cells of the BEV map and their pillars.
        bev_frame: the frame in which the grid lies.
        training_rigs: the rigs that the weights were trained on.
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
    bev_frame: BevFrameConfig = field(default_factory=BevFrameConfig)
    training_rigs: TrainingRigsConfig = field(default_factory=TrainingRigsConfig)
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
        if not len(self.backbone.output_stages) <= levels <= self._most_neck_levels():
            raise ValueError(
                f"neck.levels is {levels}; expected at least the number of backbone.output_stages, "
                f"at most image_tokens.level_embeddings"
            )

    @property
    def encoder_levels(self) -> int:
        """Number of the neck's levels that the BEV encoder attends to, the finest ones."""
        return min(self.neck.levels, self.image_tokens.level_embeddings)

    @property
    def level_shapes(self) -> LevelShapes:
        """(height, width) of each of these levels."""
        width, height = self.image.padded_size
        strides = [2 ** (stage + 1) for stage in sorted(self.backbone.output_stages)]
        while len(strides) < self.neck.levels:
            strides.append(2 * strides[-1])
        return tuple((-(-height // stride), -(-width // stride)) for stride in strides[: self.encoder_levels])

    @property
    def map_classes(self) -> tuple[str, ...]:
        """The classes of the map that the model predicts, in the order of their bits; empty without a map."""
        return tuple(MAP_CLASSES) if "segmentation" in self.heads else ()

    def _most_neck_levels(self) -> int:
        return self.image_tokens.level_embeddings


@dataclass(frozen=True)
class BEVFormerInputs:
    """One step of B sequences with N cameras.

    Attributes:
        images: (B, N, 3, H, W), normalised and padded.
        image_from_bev: (B, N, 4, 4) float32, bev metres to pixels of the network's input (rows u·d, v·d, d, 1).
        camera_index: (N,) int64, the camera embedding of each image; (B, N) where the sequences differ.
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

    def to(self, device: torch.device, *, keep_geometry: bool = False) -> BEVFormerInputs:
        """The same inputs on a device.

        keep_geometry: image_from_bev, has_image and rotation_deg stay on the CPU, where a prepared model reads them
            without waiting for a GPU.
        """
        kept = ("image_from_bev", "has_image", "rotation_deg") if keep_geometry else ()
        tensors = {part.name: getattr(self, part.name) for part in fields(self)}
        return BEVFormerInputs(**{name: x if name in kept else upload(x, device) for name, x in tensors.items()})


@dataclass(frozen=True)
class BEVFormerOutputs:
    """What one step computes.

    Attributes:
        bev: (B, Y·X, C), the BEV map. For BEVFormer it is the next frame's history.
        class_logits: (L, B, Q, classes) of the L decoder layers.
        box_codes: (L, B, Q, 10): cx, cy, log w, log l, cz, log h, sin, cos, vx, vy; centres in metres, bev frame.
        segmentation: outputs of the segmentation head, None without one.
    """

    bev: Tensor
    class_logits: Tensor
    box_codes: Tensor
    segmentation: SegmentationOutputs | None = None


class BEVFormerBase(nn.Module):
    """The parts that BEVFormer and BEVFormerV2 share, in the order of the paper's figure 2."""

    def __init__(self, config: BEVFormerConfig) -> None:
        super().__init__()
        self.config = config
        grid, channels, levels = config.bev_grid, config.channels, config.encoder_levels
        bev_shape = (grid.rows, grid.columns)
        self.backbone = ResNet(config.backbone)
        self.neck = FPN(config.backbone.output_channels(), channels, config.neck)
        self.image_tokens = ImageTokens(len(config.cameras), channels, config.image_tokens)
        embeds_rays = config.image_tokens.calibration_embedding
        self.calibration_embedding = CalibrationEmbedding(channels, config.bev_frame.height_m) if embeds_rays else None
        self.bev_queries = BevQueries(grid, channels, config.ego_motion.can_bus)
        self.pillars = Pillars(grid)
        self.encoder = Encoder(config.encoder, channels, levels, grid, config.ego_motion)
        self.decoder = Decoder(config.decoder, channels, bev_shape)
        self.detection_head = DetectionHead(config.decoder.layers, channels, len(config.classes), grid)
        segments = "segmentation" in config.heads
        self.segmentation_head = SegmentationHead(config.segmentation, channels, bev_shape) if segments else None

    def image_features(self, images: Tensor, camera_index: Tensor) -> FeatureMaps:
        """The tokens of B·N images, for the encoder.

        Args:
            images: (B, N, 3, H, W), normalised and padded.
            camera_index: (N,) or (B, N) int64, the camera embedding of each image.
        """
        feature_maps = self.neck(self.backbone(images.flatten(0, 1)))
        return self.image_tokens(feature_maps[: self.config.encoder_levels], camera_index)

    def decode(self, bev: Tensor) -> BEVFormerOutputs:
        """What the decoder and the heads find in the BEV map (B, Y·X, C)."""
        # In float32: half precision is too coarse for the refinement of boxes.
        with torch.autocast(bev.device.type, enabled=False):
            class_logits, box_codes, _ = self.decoder(bev.float(), self.detection_head)
            segmentation = None
            if self.segmentation_head is not None:
                segmentation = self.segmentation_head(bev.float(), self.bev_queries.position())
        return BEVFormerOutputs(bev, class_logits, box_codes, segmentation)


class BEVFormer(BEVFormerBase):
    """The whole model: a recurrence, in which the BEV map of a frame is the history of the next."""

    def forward(self, inputs: BEVFormerInputs, history: Tensor | None = None) -> BEVFormerOutputs:
        """One step. history: (B, Y·X, C), the BEV map of the previous frame, or None for a scene's first frame."""
        return self.decode(self.bev_map(inputs, history))

    def bev_map(self, inputs: BEVFormerInputs, history: Tensor | None) -> Tensor:
        """The BEV map (B, Y·X, C): the part of `forward` before the decoder and the heads."""
        image_features = self.image_features(inputs.images, inputs.camera_index)
        if self.calibration_embedding is not None:
            image_features = self.calibration_embedding(image_features, inputs.image_from_bev, inputs.image_size)
        return self.encoder(
            bev_query=self.bev_queries(inputs.can_bus),
            position=self.bev_queries.position(),
            image_features=image_features,
            hits=self.pillars(inputs.image_from_bev, inputs.image_size, inputs.has_image),
            history=None if history is None else self.align_history(history, inputs.rotation_deg),
            shift=inputs.shift,
        )

    def align_history(self, history: Tensor, rotation_deg: Tensor) -> Tensor:
        """The history map (B, Y·X, C), rotated by rotation_deg (B,) to the current heading."""
        center = self.config.ego_motion.history_rotation_center
        return rotate_history(history, rotation_deg, self.config.bev_grid, center)
