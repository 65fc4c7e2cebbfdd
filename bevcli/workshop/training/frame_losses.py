"""All losses of a frame by name; perspective supervision, whose detector and loss exist in training only.

Perspective supervision (BEVFormerV2, Yang et al. 2023) is a detector on the image features alone. The detection head
trains the image backbone only through the sampling points of the BEV queries. Here each box trains the features of the
pixels that show it. The targets follow FCOS3D (Wang et al. 2021): a box is detected on one level, chosen by its size in
the image, by the pixels near its projected centre.
"""

import contextlib
import copy
import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.checkpoints import load_weights
from bevcli.config import load_config
from bevcli.errors import ConfigError
from bevcli.geometry.boxes import BOX_EDGES
from bevcli.inference.load import weights_file
from bevcli.model.config import ModelConfig
from bevcli.model.kernels.choose import choose_kernels
from bevcli.model.network import Network, build_network
from bevcli.model.pillar_projection import project_points
from bevcli.model.step import ModelInputs, ModelOutputs
from bevcli.model.upload import upload
from bevcli.parsing.documents import CountOrNone, NotNegative
from bevcli.workshop.training import losses
from bevcli.workshop.training.augmentation import renormalised
from bevcli.workshop.training.kernels import find_hits_on_cpu
from bevcli.workshop.training.samples import Batch
from bevcli.workshop.training.targets import PaddedTargets, Targets

BOX_NUMBERS = 8  # offset x, offset y, log depth, log length, log width, log height, sin, cos
MAX_HALF_EXTENT = 8.0  # strides; a box with a larger half extent goes to a coarser level, as in FCOS (64 at stride 8)
POSITIVE_RADIUS = 1.5  # strides from the projected centre, along x and y, as in FCOS3D
NEAREST_PIXEL = 0.5001  # strides; at least one pixel is this near to any point of the image
MIN_CENTER_DEPTH_M = 0.5  # a box whose centre is nearer or behind the camera has no target
OUTLINE_DEPTH_M = 0.1  # the part of a box nearer than this is cut off before the outline is projected


@dataclass(frozen=True)
class FeatureLocations:
    """The S pixels of all feature maps of one image, level by level from fine to coarse, row by row."""

    pixels: Tensor  # (S, 2) x and y of their centres, pixels of the network's input
    strides: Tensor  # (L, 2) distance of neighbours along x and y on each level, pixels of the network's input
    levels: Tensor  # (S,) int64, the level of each


@dataclass(frozen=True)
class ImageObjects:
    """G boxes as each of P cameras sees them; behind the camera only `outlines` and `visible` are valid."""

    visible: Tensor  # (P, G) bool, whether any part of the box lies inside the image
    outlines: Tensor  # (P, G, 4) left, top, right, bottom of the part inside the image, pixels
    centers: Tensor  # (P, G, 2) x and y of the projected box centre, pixels; may lie outside the image
    depths: Tensor  # (P, G) of the box centre along the optical axis, metres
    focal: Tensor  # (P,) focal length, pixels: the geometric mean of fx and fy
    log_sizes: Tensor  # (P, G, 3) logarithms of length, width, height in metres
    rotations: Tensor  # (P, G, 2) sine and cosine of the heading relative to the viewing ray, about the z axis


@dataclass(frozen=True)
class PerspectiveTargets:
    """Targets of the S locations of P images. A location that is neither positive nor ignored is background."""

    positive: Tensor  # (P, S) bool, the locations that detect a box
    labels: Tensor  # (P, S) int64, classes of their boxes
    # (P, S, 8) box numbers: offset from the location to the projected centre (x, y) in strides; log of the depth in
    # metres times stride divided by focal length; log length, width, height in metres; sine and cosine of the heading
    # relative to the viewing ray. Only those of positive locations are valid
    boxes: Tensor
    ignored: Tensor  # (P, S) bool, the locations that are neither positive nor background


@lru_cache(32)
def feature_locations(
    shapes: tuple[tuple[int, int], ...], image_size: tuple[int, int], device: torch.device
) -> FeatureLocations:
    """The locations of feature maps that all cover the whole image, as the encoder samples them.

    shapes: rows and columns of each map. image_size: (height, width) of the network's input, pixels.
    """
    pixels, strides, levels = [], [], []
    for level, (rows, columns) in enumerate(shapes):
        stride = torch.tensor([image_size[1] / columns, image_size[0] / rows])
        y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        pixels.append((torch.stack([x, y], -1).flatten(0, 1) + 0.5) * stride)
        strides.append(stride)
        levels.append(torch.full((rows * columns,), level))
    return FeatureLocations(
        *(upload(part, device) for part in (torch.cat(pixels), torch.stack(strides), torch.cat(levels)))
    )


def perspective_targets(
    image_from_bev: Tensor, truth: PaddedTargets, locations: FeatureLocations, image_size: tuple[int, int]
) -> PerspectiveTargets:
    """The targets of P images.

    A box is positive on the finest level on which half the longer side of its outline spans at most 8 strides, or on
    the coarsest level. Positive are the pixels inside its outline up to 1.5 strides from its projected centre, and
    always the nearest pixel. If the centre lies outside the image, the nearest point of the outline takes its place.
    Of several boxes a pixel detects the one with the nearest centre in the image.

    The pixels of a visible box are ignored if its centre is behind the camera, or further outside the image than the
    outline is large: such a box has no usable target, but it is not background either.

    Args:
        image_from_bev: (P, 4, 4), bev metres to pixels of the network's input.
        truth: of P frames, G boxes of each; those outside the image are skipped.
        image_size: (height, width) of the network's input, pixels.
    """
    objects = project_objects(image_from_bev, truth.codes, image_size)
    start, end = objects.outlines.split(2, dim=-1)  # (P, G, 2)
    anchors = objects.centers.clamp(start, end)
    visible = objects.visible & truth.exists
    usable = visible & (objects.depths >= MIN_CENTER_DEPTH_M)
    usable &= ((objects.centers - anchors).abs() <= end - start).all(-1)

    mean_strides = locations.strides.prod(-1).sqrt()  # (L,)
    half_extents = (end - start).amax(-1) / 2
    levels = (half_extents[..., None] > MAX_HALF_EXTENT * mean_strides[:-1]).sum(-1)  # (P, G)
    pixels, strides = locations.pixels[:, None], locations.strides[levels]  # (S, 1, 2), (P, G, 2)
    to_anchor = (pixels - anchors[:, None]) / strides[:, None]  # (P, S, G, 2) strides
    distance = to_anchor.abs().amax(-1)
    inside = ((pixels >= start[:, None]) & (pixels <= end[:, None])).all(-1)  # (P, S, G)
    near = (inside & (distance <= POSITIVE_RADIUS)) | (distance <= NEAREST_PIXEL)
    detects = near & usable[:, None] & (locations.levels[:, None] == levels[:, None])

    positive = detects.any(-1)
    detected = to_anchor.norm(dim=-1).where(detects, torch.inf).argmin(-1)  # (P, S)
    depths = objects.depths[..., None] * strides.prod(-1, keepdim=True).sqrt() / objects.focal[:, None, None]
    numbers = [objects.centers, strides, depths.log(), objects.log_sizes, objects.rotations]
    chosen = torch.cat(numbers, -1).gather(1, detected[..., None].expand(-1, -1, 10))
    offsets = (chosen[..., :2] - locations.pixels) / chosen[..., 2:4]
    boxes = torch.cat([offsets, chosen[..., 4:]], -1)
    ignored = (inside & (visible & ~usable)[:, None]).any(-1) & ~positive
    return PerspectiveTargets(positive, truth.labels.gather(1, detected), boxes, ignored)


def project_objects(image_from_bev: Tensor, codes: Tensor, image_size: tuple[int, int]) -> ImageObjects:
    """The boxes of P frames, each as one camera sees them.

    Args:
        image_from_bev: (P, 4, 4), bev metres to pixels of the network's input.
        codes: (P, G, 10) box codes (see `bevcli.model.decoder`).
        image_size: (height, width) of the network's input, pixels.
    """
    matrix = image_from_bev[:, :3].double()  # on the CPU if image_from_bev is: not every device has float64
    cameras = -torch.linalg.solve(matrix[..., :3], matrix[..., 3]).float()  # their positions, metres, bev frame
    optical_axes = image_from_bev[:, 2, :3]  # unit vectors
    along_axes = (image_from_bev[:, :2, :3] * optical_axes[:, None]).sum(-1)  # the principal points
    focal = (image_from_bev[:, :2, :3].square().sum(-1) - along_axes.square()).sqrt().prod(-1).sqrt()

    image_from_bev, cameras, focal = (upload(part, codes.device) for part in (image_from_bev, cameras, focal))
    points = _entries(codes, 0, 1, 4)
    centers, depths = project_points(image_from_bev[:, None], points)
    outlines = _outlines(image_from_bev, codes, image_size)
    visible = (outlines[..., 2:] > outlines[..., :2]).all(-1)

    rays = points[..., :2] - cameras[:, None, :2]
    rays = rays / rays.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    headings = _headings(codes)
    sine = rays[..., 0] * headings[..., 1] - rays[..., 1] * headings[..., 0]
    cosine = (rays * headings).sum(-1)
    return ImageObjects(
        visible, outlines, centers, depths, focal, _entries(codes, 3, 2, 5), torch.stack([sine, cosine], -1)
    )  # fmt: skip


def _entries(codes: Tensor, *indices: int) -> Tensor:
    """(..., K), the entries at K indices of codes (..., 10). `codes[..., indices]` would wait for a GPU."""
    return torch.stack([codes[..., index] for index in indices], -1)


@lru_cache(8)
def _corner_signs(device: torch.device) -> Tensor:
    """(8, 3) 1 or -1: ahead or behind, left or right, above or below."""
    signs = torch.tensor([[1.0, 1], [-1, 1], [-1, -1], [1, -1]]).repeat(2, 1)
    return upload(torch.cat([signs, torch.tensor([-1.0] * 4 + [1.0] * 4)[:, None]], 1), device)


@lru_cache(8)
def _edges(device: torch.device) -> Tensor:
    """(24,) the corner at the first end of each edge of a box, then that at its other end."""
    return upload(torch.as_tensor(np.asarray(BOX_EDGES).T.copy()).flatten(), device)


def _outlines(image_from_bev: Tensor, codes: Tensor, image_size: tuple[int, int]) -> Tensor:
    """(P, G, 4) left, top, right, bottom of the visible parts, pixels; not left < right or top < bottom if invisible.

    Each edge is cut off at OUTLINE_DEPTH_M before it is projected: a box may lie partly behind the camera.
    """
    corners, matrix = _corners(codes), image_from_bev[:, None, None]
    projected = (matrix[..., :3, :3] * corners[..., None, :]).sum(-1) + matrix[..., :3, 3]  # (P, G, 8, 3)
    first, last = projected.index_select(2, _edges(codes.device)).chunk(2, dim=2)  # (P, G, 12, 3) each
    ends = torch.cat([_cut(first, last), _cut(last, first)], 2)  # (P, G, 24, 3)
    in_front = (torch.maximum(first[..., 2], last[..., 2]) > OUTLINE_DEPTH_M).repeat(1, 1, 2)[..., None]
    pixels = ends[..., :2] / ends[..., 2:].clamp(min=OUTLINE_DEPTH_M)
    start = pixels.where(in_front, torch.inf).amin(2)
    end = pixels.where(in_front, -torch.inf).amax(2)
    right, bottom = end[..., 0].clamp(max=image_size[1]), end[..., 1].clamp(max=image_size[0])
    return torch.cat([start.clamp(min=0), torch.stack([right, bottom], -1)], -1)


def _cut(ends: Tensor, others: Tensor) -> Tensor:
    """The ends (..., 3) of edges, those behind OUTLINE_DEPTH_M moved along the edge to that depth."""
    depth, other_depth = ends[..., 2:], others[..., 2:]
    crosses = (depth < OUTLINE_DEPTH_M) & (other_depth > OUTLINE_DEPTH_M)
    share = (OUTLINE_DEPTH_M - depth) / (other_depth - depth)
    return torch.where(crosses, ends + share * (others - ends), ends)


def _corners(codes: Tensor) -> Tensor:
    """(P, G, 8, 3) corners in the bev frame, metres, in the order of `Boxes3D.corners`."""
    signs = _corner_signs(codes.device)
    half_length, half_width, half_height = (_entries(codes, 3, 2, 5).exp() / 2)[..., None, :].unbind(-1)  # (P, G, 1)
    forward = _headings(codes)[..., None, :]  # (P, G, 1, 2)
    left = torch.stack([-forward[..., 1], forward[..., 0]], -1)
    ground = (signs[:, 0] * half_length)[..., None] * forward + (signs[:, 1] * half_width)[..., None] * left
    above = half_height * signs[:, 2]
    return torch.cat([ground, above[..., None]], -1) + _entries(codes, 0, 1, 4)[..., None, :]


def _headings(codes: Tensor) -> Tensor:
    """(..., 2) unit vectors of the headings in the bev frame, because yaw = -angle - pi/2."""
    return -codes[..., 6:8]


class PerspectiveHead(nn.Module):
    """One branch for the classes and one for the boxes, shared by all levels."""

    def __init__(self, channels: int, classes: int, layers: int) -> None:
        super().__init__()
        self.class_branch = _branch(channels, classes, layers)
        self.box_branch = _branch(channels, BOX_NUMBERS, layers)
        nn.init.constant_(self.class_branch[-1].bias, -math.log(99))  # type: ignore[arg-type]  # focal prior

    def forward(self, feature_maps: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Classes and boxes at the S locations of P images, level by level from fine to coarse, row by row.

        feature_maps: (P, C, H_l, W_l) of each level.
        Returns class logits (P, S, classes) and box numbers (P, S, 8), as `PerspectiveTargets` describes them.
        """
        logits, boxes = (
            torch.cat([branch(features).flatten(2).movedim(1, -1) for features in feature_maps], 1)
            for branch in (self.class_branch, self.box_branch)
        )
        return logits, boxes


def _branch(channels: int, outputs: int, layers: int) -> nn.Sequential:
    """`layers` convolutions with group norm, and one that predicts. A group has about 8 channels, as in FCOS3D."""
    groups = math.gcd(channels, max(1, channels // 8))
    modules: list[nn.Module] = []
    for _ in range(layers):
        convolution = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        modules += [convolution, nn.GroupNorm(groups, channels), nn.ReLU()]
    prediction = nn.Conv2d(channels, outputs, 3, padding=1)
    nn.init.normal_(prediction.weight, std=0.01)
    nn.init.zeros_(prediction.bias)  # type: ignore[arg-type]
    return nn.Sequential(*modules, prediction)


@dataclass(frozen=True)
class PerspectiveLossConfig:
    """The [training.perspective_loss] table."""

    weight: NotNegative = 0.0  # of the whole loss; 0 disables it
    layers: CountOrNone = 2  # hidden convolutions of each of the head's two branches
    class_weight: NotNegative = 2.0  # of the classes within the loss
    offset_weight: NotNegative = 0.25  # of the offsets to the projected centre within the loss
    depth_weight: NotNegative = 1.0  # of the log depths within the loss
    size_weight: NotNegative = 0.25  # of the log sizes within the loss
    rotation_weight: NotNegative = 0.25  # of the rotations within the loss


def perspective_loss(
    head: PerspectiveHead,
    feature_maps: Sequence[Tensor],
    image_from_bev: Tensor,
    has_image: Tensor,
    image_size: tuple[int, int],
    truth: PaddedTargets,
    config: PerspectiveLossConfig,
) -> dict[str, Tensor]:
    """Focal loss of all pixels and L1 loss of the positive ones, both divided by the number of positive pixels.

    Args:
        feature_maps: (B·N, C, H_l, W_l) of each level, any number of them.
        image_from_bev: (B, N, 4, 4), bev metres to pixels of the network's input.
        has_image: (B, N) bool; a camera without an image contributes nothing.
        image_size: (height, width) of the network's input, pixels.
        truth: all boxes of B frames, also those outside the BEV grid.
    """
    cameras = image_from_bev.shape[1]
    of_images = replace(
        truth, **{name: getattr(truth, name).repeat_interleave(cameras, 0) for name in ("labels", "codes", "exists")}
    )
    logits, boxes = head(feature_maps)
    shapes = tuple((features.shape[-2], features.shape[-1]) for features in feature_maps)
    locations = feature_locations(shapes, image_size, logits.device)
    of_locations = perspective_targets(image_from_bev.flatten(0, 1), of_images, locations, image_size)
    seen = upload(has_image.flatten(), logits.device)[:, None]
    positive, counted = of_locations.positive & seen, ~of_locations.ignored & seen
    count = positive.sum().clamp(min=1)
    of_boxes = positive[..., None]
    class_targets = torch.zeros_like(logits).scatter_(-1, of_locations.labels[..., None], of_boxes.to(logits.dtype))
    classes = config.class_weight * (losses.focal_loss(logits, class_targets) * counted[..., None]).sum() / count
    errors = F.l1_loss(boxes.where(of_boxes, 0), of_locations.boxes.where(of_boxes, 0), reduction="none")  # (P, S, 8)
    offset, depth, size, rotation = (part.sum() for part in errors.split([2, 1, 3, 2], dim=-1))
    box_error = config.offset_weight * offset + config.depth_weight * depth
    box_error = (box_error + config.size_weight * size + config.rotation_weight * rotation) / count
    return {"perspective classes": config.weight * classes, "perspective boxes": config.weight * box_error}


@dataclass(frozen=True)
class DistillationLossConfig:
    """The [training.distillation_loss] table."""

    weight: NotNegative = 0.0  # of the mean squared difference of the BEV maps; 0 disables this part
    # of that of the neck's maps, by the teacher's variance; it then sees augmented images
    feature_weight: NotNegative = 0.0
    teacher: str = ""  # weights of the teacher, a file or a model's name
    model: str = ""  # name or TOML file of the teacher's model; "" for the model that is trained

    def __post_init__(self) -> None:
        if self.active and not self.teacher:
            raise ValueError("teacher must name weights where weight or feature_weight is positive")

    @property
    def active(self) -> bool:
        """Some part of the loss is not disabled."""
        return max(self.weight, self.feature_weight) > 0


@dataclass(frozen=True)
class Lesson:
    """The results of a teacher for one frame of B clips with N cameras."""

    bev: Tensor | None  # (B, Y·X, C) float32; None where only the features are learned
    features: tuple[Tensor, ...]  # (B·N, C, H, W) float32 of each level of the neck; empty where not learned


class Teacher:
    """The model that another one learns from, in evaluation mode.

    It sees the images and the calibration before they were augmented or, where a model learns its features, the images
    that the model sees.
    """

    def __init__(self, model: Network, config: DistillationLossConfig, device: torch.device) -> None:
        """Raises BevcliError where the weights or the teacher's model are missing, or do not fit the model."""
        self._config, self._taught = config, model.config
        self._network = build_network(load_config(config.model)) if config.model else copy.deepcopy(model)
        load_weights(weights_file(Path(config.teacher)), self._network, config.model)
        own, other = _maps_of(model.config), _maps_of(self._network.config)
        if own != other:
            raise ConfigError(f"{config.model}: cannot teach {model.config.name}: it has {other} (expected {own})")
        self._network.eval().requires_grad_(False).to(device)
        choose_kernels(self._network, device)
        find_hits_on_cpu(self._network, device)

    @torch.no_grad()
    def lessons(self, clip: Batch) -> Iterator[Lesson]:
        """The results for each frame of clips, lazily."""
        image, own, network = self._taught.image, self._network.config.image, self._network
        memory = None
        if image != own:
            clip = replace(
                clip, inputs=tuple(replace(x, images=renormalised(x.images, image, own)) for x in clip.inputs)
            )
        for frame, inputs in enumerate(clip.inputs):
            bev = None
            with last_outputs(network.neck) as features:
                if self._config.weight:
                    outputs, memory = network.outputs_of_clip(clip, frame, memory)
                    bev = outputs.bev.float()
                else:
                    network.image_features(inputs.images, inputs.camera_index)
            yield Lesson(bev, tuple(x.float() for x in features[0]) if self._config.feature_weight else ())


def _maps_of(config: ModelConfig) -> str:
    """What a teacher and the model have in common, in words."""
    sizes = " and ".join(f"{height} x {width}" for height, width in config.level_shapes)
    grid = config.bev_grid
    maps = f"{config.neck.levels} maps of {config.channels} channels and {sizes} cells"
    return f"{maps}, {grid.rows} x {grid.columns} BEV cells"


@contextlib.contextmanager
def last_outputs(module: nn.Module) -> Iterator[deque[Any]]:
    """Inside, the only item is what the last forward pass of a part returned. No hook remains."""
    kept = deque[Any](maxlen=1)
    hook = module.register_forward_hook(lambda module, inputs, outputs: kept.append(outputs))
    try:
        yield kept
    finally:
        hook.remove()


@dataclass(frozen=True)
class LossConfigs:
    """The tables of [training] whose names end in _loss."""

    detection_loss: losses.DetectionLossConfig = field(default_factory=losses.DetectionLossConfig)  # of the boxes
    segmentation_loss: losses.SegmentationLossConfig = field(default_factory=losses.SegmentationLossConfig)  # of masks
    dense_loss: losses.DenseLossConfig = field(default_factory=losses.DenseLossConfig)  # auxiliary, on the BEV map
    perspective_loss: PerspectiveLossConfig = field(default_factory=PerspectiveLossConfig)  # on image features
    distillation_loss: DistillationLossConfig = field(default_factory=DistillationLossConfig)  # against a teacher


class FrameLosses:
    """Computes the losses of one forward pass by name.

    Attributes:
        auxiliary_heads: the heads of the dense and the perspective loss, which train along with the model. Their names
            are part of the checkpoint format.
    """

    def __init__(self, model: Network, configs: LossConfigs) -> None:
        classes = len(model.config.classes)
        self.configs = configs
        self._query_groups = model.config.decoder.training_groups
        self._hybrid_queries = model.config.hybrid_queries.count
        self._dense_head: losses.DenseHead | None = None
        self._perspective_head: PerspectiveHead | None = None
        self.auxiliary_heads = nn.ModuleDict()
        if configs.dense_loss.weight > 0:
            self._dense_head = losses.DenseHead(model.config.channels, classes, model.config.bev_grid)
            self.auxiliary_heads["dense_reader"] = self._dense_head
        if configs.perspective_loss.weight > 0:
            self._perspective_head = PerspectiveHead(model.config.channels, classes, configs.perspective_loss.layers)
            self.auxiliary_heads["perspective_head"] = self._perspective_head

    @contextlib.contextmanager
    def watching(self, model: Network) -> Iterator[None]:
        """Inside, each forward pass of the model keeps its image features for the losses on them. No hook remains."""
        with last_outputs(model.neck) as self._feature_maps:
            yield

    def __call__(
        self, inputs: ModelInputs, outputs: ModelOutputs, targets: Targets, taught: Lesson | None = None
    ) -> dict[str, Tensor]:
        """The weighted scalar losses by name; their sum is minimised.

        Call it inside `watching`, right after the forward pass that made the outputs.
        taught: by the teacher.
        """
        weights, own = self.configs.detection_loss, outputs.class_logits.shape[2] - self._hybrid_queries
        logits, codes = outputs.class_logits[:, :, :own], outputs.box_codes[:, :, :own]
        terms = losses.detection_loss(logits, codes, targets.detection, weights, self._query_groups)
        if self._dense_head is not None:
            bev, config = outputs.bev.float(), self.configs.dense_loss
            terms |= losses.dense_loss(self._dense_head, bev, targets.detection, config, weights)
        if self._perspective_head is not None:
            terms |= perspective_loss(
                self._perspective_head,
                [features.float() for features in self._feature_maps[0]],
                inputs.image_from_bev,
                inputs.has_image,
                inputs.image_size,
                targets.perspective,
                self.configs.perspective_loss,
            )
        if taught is not None and taught.bev is not None:
            difference = nn.functional.mse_loss(outputs.bev.float(), taught.bev)
            terms |= {"distillation": self.configs.distillation_loss.weight * difference}
        if taught is not None and taught.features:
            pairs = zip(self._feature_maps[0], taught.features, strict=True)
            shares = [nn.functional.mse_loss(own.float(), other) / other.var() for own, other in pairs]
            terms |= {"features": self.configs.distillation_loss.feature_weight * torch.stack(shares).mean()}
        if outputs.segmentation is not None and targets.segmentation is not None:
            terms |= losses.segmentation_loss(
                outputs.segmentation, targets.segmentation, self.configs.segmentation_loss
            )
        return terms
