"""The configuration that every model has: images, BEV grid, the parts that models share, the rigs of its training.

`training_rig_notes` warns where a drive's rig is far from those.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from bevcli.frame import MAP_CLASSES, FrameResult
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.cameras import BEV_ORIGIN_M, Camera, CameraRig
from bevcli.geometry.object_classes import ClassSettings, ObjectClass, object_classes
from bevcli.model.decoder import DecoderConfig
from bevcli.model.deformable_attention import LevelShapes
from bevcli.model.efficientnet_lite import EfficientNetLiteConfig
from bevcli.model.ego_motion import EgoMotionConfig
from bevcli.model.encoder import EncoderConfig
from bevcli.model.fpn import FPNConfig
from bevcli.model.hybrid_queries import HybridQueriesConfig
from bevcli.model.image_boxes import IMAGE_CLASSES
from bevcli.model.image_tokens import ImageTokensConfig
from bevcli.model.nanodet import CHANNELS, NanoDetConfig
from bevcli.model.resnet import ResNetConfig
from bevcli.model.segmentation import SegmentationConfig
from bevcli.parsing.documents import Count, Positive
from bevcli.printing import counted

# Largest values of the whole numbers of a model, by name or its last word; of any other number LARGEST_NUMBER.
LARGEST = {
    "layers": 100, "blocks": 200, "heads": 256, "levels": 16, "points": 256, "groups": 100, "scale": 32,
    "channels": 4096, "width": 1024, "rows": 2000, "columns": 2000, "queries": 100_000, "pixels": 10**9,
    "feed_forward_width": 20_000, "mask_feed_forward_width": 20_000,
}  # fmt: skip
LARGEST_NUMBER = 20_000
# How far outside the range of the training a camera may be without a note.
_FOV_DEG, _HEIGHT_M, _TILT_DEG = 8.0, 0.3, 1.5
_BEV_TILT_DEG = 4.0  # published weights were trained with nuScenes' LIDAR_TOP, which is tilted by up to 3 degrees


@dataclass(frozen=True)
class ImageConfig:
    """The network's input made of an image: resized, cropped, normalised in float, padded at right and bottom."""

    # (width, height) in pixels that an image is resized to. Images of another aspect ratio are scaled to fit inside
    size: tuple[Count, Count]
    mean: tuple[float, float, float]  # of each channel, subtracted, on the scale 0 to 255 and in color_order
    std: tuple[Positive, Positive, Positive]  # of each channel, the divisor, on the same scale
    color_order: Literal["rgb", "bgr"]  # order of the channels, "rgb" or "bgr"
    pad_divisor: Count = 32  # width and height are padded with zeros to a multiple of it
    # "linear", as the published weights were trained, aliases where images shrink to less than half; "area" averages
    # the pixels that fall into one
    resize: Literal["linear", "area"] = "linear"
    # whether projections follow the resized image exactly: it keeps the corners of the image, so that pixel u goes to
    # (u + 0.5) * scale - 0.5. If false, it goes to u * scale, as the published weights were trained, which is 0.3
    # pixels off where 1600 pixels become 512
    half_pixel_shift: bool = False
    # (left, top, right, bottom) in pixels of the resized image: the part that the network sees. None for all
    crop: tuple[int, int, int, int] | None = None
    # images of wide cameras become larger than `size`: their median focal length becomes this, in pixels of the
    # network's input, so that objects at the same distance have the same size for every rig
    # (`bevcli.inference.preprocess.image_for_rig`). None: `size` holds for every rig
    focal_px: Positive | None = None
    # with `focal_px`, images become larger only as long as all images of a frame have no more pixels
    max_pixels: Count | None = None
    # move the grey levels of dark, pale and foggy images into an ordinary range first
    # (`bevcli.inference.image_repair.auto_levels`), so that the model sees more in the dark and in fog
    auto_levels: bool = False
    # take away the light that fog adds to an image, before its levels are moved
    # (`bevcli.inference.image_repair.defogged`)
    defog: bool = False
    # smooth images with strong noise, as of a camera in the dark (`bevcli.inference.image_repair.denoised`)
    denoise: bool = False

    def __post_init__(self) -> None:
        left, top, right, bottom = self.crop_box
        if not (0 <= left < right <= self.size[0] and 0 <= top < bottom <= self.size[1]):
            raise ValueError("crop must be left, top, right, bottom inside size, left < right and top < bottom")
        if (self.focal_px is None) != (self.max_pixels is None):
            raise ValueError("focal_px and max_pixels must be given together")
        if self.focal_px is not None and self.crop is not None:
            raise ValueError("crop and focal_px exclude each other: with focal_px the size depends on the rig")

    @property
    def crop_box(self) -> tuple[int, int, int, int]:
        """Left, top, right and bottom of the part of the resized image that the network sees, pixels."""
        return (0, 0, *self.size) if self.crop is None else self.crop

    @property
    def pad_bgr(self) -> tuple[float, ...]:
        """The pixels (B, G, R) outside the resized image: the mean, which normalisation turns into zero."""
        return self.mean[::-1] if self.color_order == "rgb" else self.mean

    @property
    def padded_size(self) -> tuple[int, int]:
        """(width, height) of the network's input, pixels."""
        left, top, right, bottom = self.crop_box
        width, height = (-(-extent // self.pad_divisor) * self.pad_divisor for extent in (right - left, bottom - top))
        return width, height


@dataclass(frozen=True)
class BevFrameConfig:
    """The bev frame that a model was trained in, relative to the ego frame, whose origin is on the ground."""

    # whether the z axis of the bev frame must be vertical. The bev frame of every drive is then replaced by a level one
    # with the same heading and origin, at the height `height_m`. If false, the drive's is used
    level: bool = False
    height_m: float = BEV_ORIGIN_M[2]  # height of the origin above the ground, metres; nuScenes' LIDAR_TOP has 1.84
    # whether a level bev frame stays level with the road where the poses show that the body pitches and rolls over it
    # (`Frame.road_normal`). If false, it pitches and rolls with the body
    follow_road: bool = False


@dataclass(frozen=True)
class TrainingRigsConfig:
    """The rigs that a model's weights were trained on. It changes no result: a drive's rig is compared with it."""

    cameras: tuple[int, int] = (0, 0)  # smallest and largest number of cameras; 0 and 0 where the rigs are not known
    fov_deg: tuple[float, float] = (0.0, 180.0)  # smallest and largest horizontal field of view
    height_m: tuple[float, float] = (0.0, 10.0)  # smallest and largest height of a camera above the ground
    tilt_deg: float = 90.0  # largest pitch or roll of a camera
    cost: str = ""  # what other rigs were measured to cost, in words

    @property
    def known(self) -> bool:
        """The model's file states the rigs."""
        return self.cameras[1] > 0


@dataclass(frozen=True)
class ModelConfig:
    """A whole model. `bevcli.config.load_config` reads it from a TOML file.

    A model with settings of its own has a subclass, which may also override the properties.

    Attributes:
        architecture: name of the registered model; the key `architecture` of a TOML file chooses it.
        has_tracks: the model gives its boxes identities over time.
        trains_with_gaps: a training clip leaves out one of its earlier frames, as published for BEVFormer.
        trains_with_more_levels: the neck may have more levels than there are level embeddings, for training only.
        name: of the model.
        classes: of the objects, in the order of the class logits.
        class_settings: settings of classes by name, where they differ from the defaults.
        cameras: names of the camera embeddings, in their order.
        image: how images become the network's input.
        bev_grid: the cells of the BEV map and their pillars.
        bev_frame: the frame in which the grid lies.
        training_rigs: the rigs that the weights were trained on.
        rate_hz: frame rate of the training data.
        max_gap_s: after a longer time between two frames the history is dropped.
        channels: C, of all tokens and queries.
        heads: what is computed from the BEV map; "segmentation" adds the head that `segmentation` configures.
        backbone: the image backbone, of the kind that its key `kind` names.
        backbone_scale: it sees the images of the network's input at this share of their size, numerator and
            denominator; a detector beside it sees them whole.
        image_detector: a detector beside the backbone, for the boxes in the images. None: the backbone itself, if it
            is one, tells these boxes.
        horizon: the rig of each frame is levelled first, by the slopes of the road that `Horizon` tells; with
            `hybrid_queries.level` by these and what boxes and points tell.
        neck: the feature pyramid network.
        image_tokens: camera and level embeddings.
        ego_motion: can-bus numbers and alignment of the history.
        encoder: the BEV encoder.
        decoder: the object decoder.
        segmentation: the segmentation head.
    """

    architecture: ClassVar[str] = "BEVFormer"
    has_tracks: ClassVar[bool] = False
    trains_with_gaps: ClassVar[bool] = True
    trains_with_more_levels: ClassVar[bool] = False

    name: str
    classes: tuple[str, ...]
    cameras: tuple[str, ...]
    image: ImageConfig
    bev_grid: BevGrid
    bev_frame: BevFrameConfig = field(default_factory=BevFrameConfig)
    training_rigs: TrainingRigsConfig = field(default_factory=TrainingRigsConfig)
    rate_hz: Positive = 2.0
    max_gap_s: Positive = 2.0
    channels: Count = 256
    heads: tuple[Literal["detection", "segmentation"], ...] = ("detection",)
    backbone: ResNetConfig | EfficientNetLiteConfig | NanoDetConfig = field(default_factory=ResNetConfig)
    backbone_scale: tuple[int, int] = (1, 1)
    image_detector: NanoDetConfig | None = None
    horizon: bool = False
    neck: FPNConfig = field(default_factory=FPNConfig)
    image_tokens: ImageTokensConfig = field(default_factory=ImageTokensConfig)
    ego_motion: EgoMotionConfig = field(default_factory=EgoMotionConfig)
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    hybrid_queries: HybridQueriesConfig = field(default_factory=HybridQueriesConfig)
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    class_settings: Mapping[str, ClassSettings] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_numbers(self)
        grid, levels = self.bev_grid, self.neck.levels
        if any(start >= end for start, end in (grid.x_range_m, grid.y_range_m, grid.z_range_m)):
            raise ValueError("bev_grid: each range goes from a smaller to a larger number")
        object_classes(self.classes, self.class_settings)
        if self.hybrid_queries.count and self.detector is None:
            raise ValueError('hybrid_queries needs image_detector, or a backbone that is a detector, such as "nanodet"')
        if self.hybrid_queries.count and self.hybrid_queries.features != CHANNELS:
            raise ValueError(f"hybrid_queries.features must be the channels of the detector's maps, {CHANNELS}")
        smaller, whole = self.backbone_scale
        if not 0 < smaller <= whole or self.image.pad_divisor * smaller % whole:
            raise ValueError("backbone_scale must be at most 1, and image.pad_divisor times it a whole number")
        if not self.cameras:
            raise ValueError("cameras must not be empty")
        if "detection" not in self.heads or len(set(self.heads)) < len(self.heads):
            raise ValueError('heads must name "detection", and no head twice')
        divisors = [2, self.encoder.attention_heads, self.decoder.attention_heads]
        if "segmentation" in self.heads:
            divisors.append(self.segmentation.attention_heads)
        if any(self.channels % divisor for divisor in divisors):
            raise ValueError(f"channels is {self.channels}; it must be even and a multiple of the attention_heads")
        if self.encoder.spatial_points % grid.pillar_points:
            raise ValueError("encoder.spatial_points must be a multiple of bev_grid.pillar_points")
        most = levels if self.trains_with_more_levels else self.image_tokens.level_embeddings
        if not len(self.backbone.output_stages) <= levels <= most:
            raise ValueError(
                f"neck.levels is {levels}; expected at least the number of backbone.output_stages, "
                f"at most image_tokens.level_embeddings"
            )

    @property
    def object_classes(self) -> dict[str, ObjectClass]:
        """The classes by name, in the order of the class logits."""
        return object_classes(self.classes, self.class_settings)

    @property
    def encoder_levels(self) -> int:
        """Number of the neck's levels that the BEV encoder attends to, the finest ones."""
        return min(self.neck.levels, self.image_tokens.level_embeddings)

    @property
    def level_shapes(self) -> LevelShapes:
        """(height, width) of each of these levels."""
        width, height = self.image.padded_size
        return self.level_shapes_of((height, width))

    def level_shapes_of(self, image_size: tuple[int, int]) -> LevelShapes:
        """(height, width) of each of these levels for images of another size (height, width), pixels."""
        height, width = image_size
        smaller, whole = self.backbone_scale
        height, width = height * smaller // whole, width * smaller // whole
        strides = sorted(self.backbone.output_strides())
        while len(strides) < self.neck.levels:
            strides.append(2 * strides[-1])
        return tuple((-(-height // stride), -(-width // stride)) for stride in strides[: self.encoder_levels])

    @property
    def map_classes(self) -> tuple[str, ...]:
        """The classes of the map that the model predicts, in the order of their bits; empty without a map."""
        return tuple(MAP_CLASSES) if "segmentation" in self.heads else ()

    @property
    def object_queries(self) -> int:
        """The number of object queries, learned and hybrid ones, that the model's boxes come from."""
        return self.decoder.queries + self.hybrid_queries.count

    @property
    def image_classes(self) -> tuple[str, ...]:
        """The classes of the boxes in the images, in the order of their labels; empty without a detector."""
        return () if self.detector is None else IMAGE_CLASSES

    @property
    def levels(self) -> bool:
        """Whether the model levels the rig of each frame by the boxes in the images."""
        return self.image_detector is not None and self.hybrid_queries.count > 0 and self.hybrid_queries.level

    @property
    def detector(self) -> NanoDetConfig | None:
        """What tells the boxes in the images: the detector beside the backbone, or the backbone where it is one."""
        return self.backbone if isinstance(self.backbone, NanoDetConfig) else self.image_detector

    @property
    def results(self) -> Mapping[type[FrameResult], tuple[str, ...]]:
        """Types of the model's further results, with their names: classes of the lines, commands of the plan."""
        return {}

    @property
    def past_frames(self) -> int:
        """Number of frames before the current one that a window reaches; 0 without a window."""
        return 0

    @property
    def later_frames(self) -> int:
        """Number of frames after the current one that a step needs."""
        return 0

    @property
    def future_times_s(self) -> tuple[float, ...]:
        """Seconds after a frame at which the model predicts places of objects and the vehicle; empty for none."""
        return ()

    @property
    def uses_history(self) -> bool:
        """Earlier or later frames change the result."""
        return True

    def check_training(self, clip_frames: int) -> None:
        """Raise ConfigError if the model cannot be trained on clips of this many frames."""


def _check_numbers(config: Any, prefix: str = "") -> None:
    """Raises ValueError for a whole number that no model has, before anything of its size is made."""
    for setting in fields(config):
        value = getattr(config, setting.name)
        if is_dataclass(value):
            _check_numbers(value, f"{prefix}{setting.name}.")
        most = LARGEST.get(setting.name, LARGEST.get(setting.name.rpartition("_")[2], LARGEST_NUMBER))
        for number in value if isinstance(value, tuple) else (value,):
            if type(number) is int and abs(number) > most:
                raise ValueError(f"{prefix}{setting.name} is {number} (expected at most {most})")


def training_rig_notes(rig: CameraRig, config: ModelConfig) -> tuple[str, ...]:
    """Warnings where a rig lies outside the training distribution, at most two: the cameras, and the bev frame."""
    notes, trained = [], config.training_rigs
    if trained.known and rig.cameras:
        count, heights = len(rig.cameras), [float(camera.ego_from_camera[2, 3]) for camera in rig.cameras]
        fovs = [fov_deg(camera) for camera in rig.cameras]
        tilt = max(tilt_deg(camera) for camera in rig.cameras)
        far = []
        if not trained.cameras[0] <= count <= trained.cameras[1]:
            far.append(f"{counted(count, 'cameras')} ({_range(trained.cameras, '')})")
        if min(heights) < trained.height_m[0] - _HEIGHT_M or max(heights) > trained.height_m[1] + _HEIGHT_M:
            trained_range = _range(trained.height_m, " m")
            far.append(f"camera heights {_range((min(heights), max(heights)), ' m')} ({trained_range})")
        if min(fovs) < trained.fov_deg[0] - _FOV_DEG or max(fovs) > trained.fov_deg[1] + _FOV_DEG:
            far.append(f"fields of view {_range((min(fovs), max(fovs)), '°', 0)} ({_range(trained.fov_deg, '°', 0)})")
        if tilt > trained.tilt_deg + _TILT_DEG:
            far.append(f"pitch or roll up to {tilt:.1f}° ({trained.tilt_deg:g}°)")
        if far:
            cost = f"; measured: {trained.cost}" if trained.cost else ""
            theirs = "the rig is unlike those that the weights were trained on (theirs in brackets)"
            notes.append(f"{theirs}: {', '.join(far)}{cost}")
    tilt = float(np.degrees(np.arccos(np.clip(rig.ego_from_bev[2, 2], -1, 1))))
    height, expected = float(rig.ego_from_bev[2, 3]), config.bev_frame
    if expected.level and (tilt >= 0.1 or abs(height - expected.height_m) >= 0.05):
        notes.append(
            f"the bev frame is tilted by {tilt:.1f}° and {height:.2f} m high, but the weights expect a level one "
            f"at {expected.height_m:g} m: the model computes in such a frame, and gives boxes back in ego and world"
        )
    if not expected.level and tilt > _BEV_TILT_DEG:
        off = 30 * np.tan(np.radians(tilt))
        notes.append(
            f"the bev frame is tilted by {tilt:.1f}°, but the weights were trained with one tilted by up to 3°: "
            f'boxes 30 m away may be {off:.1f} m too high or too low (level "ego_from_bev" in the calibration)'
        )
    return tuple(notes)


def weights_facts(config: ModelConfig) -> dict[str, str]:
    """The metadata of a weights file: the model, its classes and cameras, and the frame and rigs that it expects."""
    x0, x1 = config.bev_grid.x_range_m
    frame = config.bev_frame
    facts = {
        "model": config.name,
        "classes": json.dumps(config.classes, ensure_ascii=False),
        "cameras": json.dumps(config.cameras, ensure_ascii=False),
        "bev_frame": f"level, {frame.height_m:g} m above the ground" if frame.level else "as in the drive",
        "range_m": f"{x0:g} to {x1:g}",
    }
    rigs = config.training_rigs
    if not rigs.known:
        return facts
    count = "{} to {}".format(*rigs.cameras) if rigs.cameras[0] < rigs.cameras[1] else f"{rigs.cameras[0]}"
    lenses = "field of view {:g} to {:g}°".format(*rigs.fov_deg)
    places = "height {:g} to {:g} m, pitch and roll up to {:g}°".format(*rigs.height_m, rigs.tilt_deg)
    return facts | {"training_rigs": f"{counted(count, 'cameras')}, {lenses}, {places}"}


def facts_notes(facts: Mapping[str, str], config: ModelConfig) -> Iterator[str]:
    """Warnings where the model's file contradicts the bev frame or the classes that the weights file states."""
    expected_facts = weights_facts(config)
    if facts.get("classes", expected_facts["classes"]) != expected_facts["classes"]:
        names = [listed.strip("[]").replace('"', "") for listed in (facts["classes"], expected_facts["classes"])]
        yield "the weights were trained for the classes {}, but the model's file names {}".format(*names)
    expected = expected_facts["bev_frame"]
    frame = facts.get("bev_frame", expected)
    if frame != expected:
        yield (
            f'the weights were trained with a bev frame "{frame}", but the model\'s file gives them one "{expected}": '
            "set [bev_frame] in the model's file"
        )


def fov_deg(camera: Camera) -> float:
    """Horizontal field of view without distortion, degrees."""
    focal, center = camera.intrinsics[0, 0], camera.intrinsics[0, 2]
    return float(np.degrees(np.arctan(center / focal) + np.arctan((camera.width - center) / focal)))


def tilt_deg(camera: Camera) -> float:
    """The larger of pitch and roll, degrees; a camera upside down or on its side has a roll near 0."""
    heights = np.abs(camera.ego_from_camera[2, [0, 2]])  # of the axes to the right and ahead
    return float(np.degrees(np.arcsin(np.clip(heights, 0, 1))).max())


def _range(ends: tuple[float, float], unit: str, digits: int = 1) -> str:
    low, high = (f"{end:.{digits}f}".removesuffix(".0") for end in ends)
    return f"{low}{unit}" if low == high else f"{low} to {high}{unit}"
