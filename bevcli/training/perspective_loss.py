"""Perspective supervision (BEVFormerV2, Yang et al. 2023): a detector on the image features alone, and its loss.

The detection head trains the image backbone only through the sampling points of the BEV queries. Here each box trains
the features of the pixels that show it. Head and loss exist in training only. The targets follow FCOS3D (Wang et al.
2021): a box is detected on one level, chosen by its size in the image, by the pixels near its projected centre.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.geometry.boxes import BOX_EDGES
from bevcli.model.matching import focal_loss
from bevcli.model.pillar_projection import project_points
from bevcli.training.detection_loss import DetectionTargets

BOX_NUMBERS = 8  # offset x, offset y, log depth, log length, log width, log height, sin, cos
MAX_HALF_EXTENT = 8.0  # strides; a box with a larger half extent goes to a coarser level, as in FCOS (64 at stride 8)
POSITIVE_RADIUS = 1.5  # strides from the projected centre, along x and y, as in FCOS3D
NEAREST_PIXEL = 0.5001  # strides; at least one pixel is this near to any point of the image
MIN_CENTER_DEPTH_M = 0.5  # a box whose centre is nearer or behind the camera has no target
OUTLINE_DEPTH_M = 0.1  # the part of a box nearer than this is cut off before the outline is projected


@dataclass(frozen=True)
class FeatureLocations:
    """The S pixels of all feature maps of one image, level by level from fine to coarse, row by row.

    Attributes:
        pixels: (S, 2) x and y of their centres, pixels of the network's input.
        strides: (L, 2) distance of neighbours along x and y on each level, pixels of the network's input.
        levels: (S,) int64, the level of each.
    """

    pixels: Tensor
    strides: Tensor
    levels: Tensor


@dataclass(frozen=True)
class ImageObjects:
    """G boxes as one camera sees them. Only `outlines` and `visible` are valid for a centre behind the camera.

    Attributes:
        visible: (G,) bool, whether any part of the box lies inside the image.
        outlines: (G, 4) left, top, right, bottom of the part inside the image, pixels.
        centers: (G, 2) x and y of the projected box centre, pixels; may lie outside the image.
        depths: (G,) of the box centre along the optical axis, metres.
        focal: () focal length, pixels: the geometric mean of fx and fy.
        log_sizes: (G, 3) logarithms of length, width, height in metres.
        rotations: (G, 2) sine and cosine of the heading relative to the viewing ray (allocentric), about the z axis.
    """

    visible: Tensor
    outlines: Tensor
    centers: Tensor
    depths: Tensor
    focal: Tensor
    log_sizes: Tensor
    rotations: Tensor


@dataclass(frozen=True)
class PerspectiveTargets:
    """Targets of the S locations of one image. Locations that are not named are background.

    Attributes:
        locations: (K,) int64, the locations that detect a box.
        labels: (K,) int64, classes of their boxes.
        boxes: (K, 8) box numbers: offset from the location to the projected centre (x, y) in strides; log of the
            depth in metres times stride divided by focal length; log length, width, height in metres; sine and cosine
            of the heading relative to the viewing ray.
        ignored: (S,) bool, the locations that are neither positive nor background.
    """

    locations: Tensor
    labels: Tensor
    boxes: Tensor
    ignored: Tensor


def feature_locations(
    shapes: Sequence[tuple[int, int]], image_size: tuple[int, int], device: torch.device
) -> FeatureLocations:
    """The locations of feature maps that all cover the whole image, as the encoder samples them.

    shapes: rows and columns of each map. image_size: (height, width) of the network's input, pixels.
    """
    pixels, strides, levels = [], [], []
    for level, (rows, columns) in enumerate(shapes):
        stride = torch.tensor([image_size[1] / columns, image_size[0] / rows], device=device)
        y, x = torch.meshgrid(torch.arange(rows, device=device), torch.arange(columns, device=device), indexing="ij")
        pixels.append((torch.stack([x, y], -1).flatten(0, 1) + 0.5) * stride)
        strides.append(stride)
        levels.append(torch.full((rows * columns,), level, device=device))
    return FeatureLocations(torch.cat(pixels), torch.stack(strides), torch.cat(levels))


def perspective_targets(
    image_from_bev: Tensor, truth: DetectionTargets, locations: FeatureLocations, image_size: tuple[int, int]
) -> PerspectiveTargets:
    """The targets of one image.

    A box is positive on the finest level on which half the longer side of its outline spans at most 8 strides, or on
    the coarsest level. Positive are the pixels inside its outline up to 1.5 strides from its projected centre, and
    always the nearest pixel. If the centre lies outside the image, the nearest point of the outline takes its place.
    Of several boxes a pixel detects the one with the nearest centre in the image.

    The pixels of a visible box are ignored if its centre is behind the camera, or further outside the image than the
    outline is large: such a box has no usable target, but it is not background either.

    Args:
        image_from_bev: (4, 4), bev metres to pixels of the network's input.
        truth: G boxes; those outside the image are skipped.
        image_size: (height, width) of the network's input, pixels.
    """
    if not len(truth.codes):
        none = torch.zeros(0, dtype=torch.int64, device=truth.codes.device)
        ignored = torch.zeros_like(locations.levels, dtype=torch.bool)
        return PerspectiveTargets(none, none, truth.codes.new_zeros(0, BOX_NUMBERS), ignored)
    objects = project_objects(image_from_bev, truth.codes, image_size)
    start, end = objects.outlines[:, :2], objects.outlines[:, 2:]
    anchors = objects.centers.clamp(start, end)
    usable = objects.visible & (objects.depths >= MIN_CENTER_DEPTH_M)
    usable &= ((objects.centers - anchors).abs() <= end - start).all(-1)

    mean_strides = locations.strides.prod(-1).sqrt()  # (L,)
    half_extents = (end - start).amax(-1) / 2
    levels = (half_extents[:, None] > MAX_HALF_EXTENT * mean_strides[:-1]).sum(-1)  # (G,)
    to_anchor = (locations.pixels[:, None] - anchors) / locations.strides[levels]  # (S, G, 2) strides
    distance = to_anchor.abs().amax(-1)
    inside = ((locations.pixels[:, None] >= start) & (locations.pixels[:, None] <= end)).all(-1)  # (S, G)
    near = (inside & (distance <= POSITIVE_RADIUS)) | (distance <= NEAREST_PIXEL)
    detects = near & usable & (locations.levels[:, None] == levels)

    positive = detects.any(-1)
    detected = torch.where(detects, to_anchor.norm(dim=-1), torch.inf)[positive].argmin(-1)  # (K,)
    strides = locations.strides[levels[detected]]  # (K, 2)
    offset = (objects.centers[detected] - locations.pixels[positive]) / strides
    depth = objects.depths[detected] * strides.prod(-1).sqrt() / objects.focal
    numbers = [offset, depth.log()[:, None], objects.log_sizes[detected], objects.rotations[detected]]
    ignored = (inside & objects.visible & ~usable).any(-1) & ~positive
    return PerspectiveTargets(positive.nonzero()[:, 0], truth.labels[detected], torch.cat(numbers, -1), ignored)


def project_objects(image_from_bev: Tensor, codes: Tensor, image_size: tuple[int, int]) -> ImageObjects:
    """The boxes as one camera sees them.

    Args:
        image_from_bev: (4, 4), bev metres to pixels of the network's input.
        codes: (G, 10) box codes (see `bevcli.model.box_coding`).
        image_size: (height, width) of the network's input, pixels.
    """
    matrix = image_from_bev[:3].double()  # on the CPU if image_from_bev is: not every device has float64
    camera = -torch.linalg.solve(matrix[:, :3], matrix[:, 3]).to(codes)  # its position, metres, bev frame
    image_from_bev = image_from_bev.to(codes.device)
    points = codes[:, [0, 1, 4]]
    centers, depths = project_points(image_from_bev, points)
    outlines = _outlines(image_from_bev, codes, image_size)
    visible = (outlines[:, 2:] > outlines[:, :2]).all(-1)

    optical_axis = image_from_bev[2, :3]  # a unit vector
    along_axis = image_from_bev[:2, :3] @ optical_axis  # the principal point
    focal = (image_from_bev[:2, :3].square().sum(-1) - along_axis.square()).sqrt().prod().sqrt()

    rays = points[:, :2] - camera[:2]
    rays = rays / rays.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    headings = _headings(codes)
    sine = rays[:, 0] * headings[:, 1] - rays[:, 1] * headings[:, 0]
    cosine = (rays * headings).sum(-1)
    return ImageObjects(
        visible, outlines, centers, depths, focal, codes[:, [3, 2, 5]], torch.stack([sine, cosine], -1)
    )  # fmt: skip


def _outlines(image_from_bev: Tensor, codes: Tensor, image_size: tuple[int, int]) -> Tensor:
    """(G, 4) left, top, right, bottom of the visible parts, pixels; not left < right or not top < bottom if invisible.

    Each edge is cut off at OUTLINE_DEPTH_M before it is projected: a box may lie partly behind the camera.
    """
    corners = _corners(codes)
    projected = (image_from_bev[:3, :3] * corners[..., None, :]).sum(-1) + image_from_bev[:3, 3]  # (G, 8, 3)
    one, other = projected[:, BOX_EDGES].unbind(2)  # (G, 12, 3) each
    ends = torch.cat([_cut(one, other), _cut(other, one)], 1)  # (G, 24, 3)
    in_front = (torch.maximum(one[..., 2], other[..., 2]) > OUTLINE_DEPTH_M).repeat(1, 2)[..., None]
    pixels = ends[..., :2] / ends[..., 2:].clamp(min=OUTLINE_DEPTH_M)
    start = torch.where(in_front, pixels, torch.inf).amin(1)
    end = torch.where(in_front, pixels, -torch.inf).amax(1)
    corner = pixels.new_tensor([image_size[1], image_size[0]])
    return torch.cat([start.clamp(min=0), torch.minimum(end, corner)], -1)


def _cut(ends: Tensor, others: Tensor) -> Tensor:
    """The ends (..., 3) of edges, those behind OUTLINE_DEPTH_M moved along the edge to that depth."""
    depth, other_depth = ends[..., 2:], others[..., 2:]
    crosses = (depth < OUTLINE_DEPTH_M) & (other_depth > OUTLINE_DEPTH_M)
    share = (OUTLINE_DEPTH_M - depth) / (other_depth - depth)
    return torch.where(crosses, ends + share * (others - ends), ends)


def _corners(codes: Tensor) -> Tensor:
    """(G, 8, 3) corners in the bev frame, metres, in the order of `Boxes3D.corners`."""
    signs = codes.new_tensor([[1, 1], [-1, 1], [-1, -1], [1, -1]]).repeat(2, 1)
    half_length, half_width, half_height = (codes[:, [3, 2, 5]].exp() / 2)[:, None].unbind(-1)  # (G, 1) each
    forward = _headings(codes)[:, None]  # (G, 1, 2)
    left = torch.stack([-forward[..., 1], forward[..., 0]], -1)
    ground = (signs[:, 0] * half_length)[..., None] * forward + (signs[:, 1] * half_width)[..., None] * left
    above = half_height * codes.new_tensor([-1.0] * 4 + [1.0] * 4)
    return torch.cat([ground, above[..., None]], -1) + codes[:, None, [0, 1, 4]]


def _headings(codes: Tensor) -> Tensor:
    """(G, 2) unit vectors of the headings in the bev frame, because yaw = -angle - pi/2."""
    return -codes[:, [6, 7]]


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
    """The [training.perspective_loss] table.

    Attributes:
        weight: of the whole loss; 0 disables it.
        layers: hidden convolutions of each of the head's two branches.
        class_weight: of the classes within the loss.
        offset_weight: of the offsets to the projected centre within the loss.
        depth_weight: of the log depths within the loss.
        size_weight: of the log sizes within the loss.
        rotation_weight: of the rotations within the loss.
    """

    weight: float = 0.0
    layers: int = 2
    class_weight: float = 2.0
    offset_weight: float = 0.25
    depth_weight: float = 1.0
    size_weight: float = 0.25
    rotation_weight: float = 0.25

    def __post_init__(self) -> None:
        if min(vars(self).values()) < 0:
            raise ValueError("layers and the weights must not be negative")


def perspective_loss(
    head: PerspectiveHead,
    feature_maps: Sequence[Tensor],
    image_from_bev: Tensor,
    has_image: Tensor,
    image_size: tuple[int, int],
    targets: Sequence[DetectionTargets],
    config: PerspectiveLossConfig,
) -> dict[str, Tensor]:
    """Focal loss of all pixels and L1 loss of the positive ones, both divided by the number of positive pixels.

    Args:
        feature_maps: (B·N, C, H_l, W_l) of each level, any number of them.
        image_from_bev: (B, N, 4, 4), bev metres to pixels of the network's input.
        has_image: (B, N) bool; a camera without an image contributes nothing.
        image_size: (height, width) of the network's input, pixels.
        targets: B, all boxes of a frame, also those outside the BEV grid.
    """
    logits, boxes = head(feature_maps)
    shapes = [(features.shape[-2], features.shape[-1]) for features in feature_maps]
    locations = feature_locations(shapes, image_size, logits.device)
    class_targets = torch.zeros_like(logits)
    counted = has_image.to(logits.device).flatten()[:, None].repeat(1, logits.shape[1])
    predicted, truths = [boxes[0, :0]], [boxes.new_zeros(0, BOX_NUMBERS)]  # (K_i, 8) of each image
    cameras = image_from_bev.shape[1]
    for image in has_image.flatten().nonzero()[:, 0].tolist():
        matrix = image_from_bev[image // cameras, image % cameras]
        truth = perspective_targets(matrix, targets[image // cameras], locations, image_size)
        class_targets[image, truth.locations, truth.labels] = 1
        counted[image] &= ~truth.ignored
        predicted.append(boxes[image, truth.locations])
        truths.append(truth.boxes)
    count = max(sum(map(len, truths)), 1)
    classes = config.class_weight * (focal_loss(logits, class_targets) * counted[..., None]).sum() / count
    errors = F.l1_loss(torch.cat(predicted), torch.cat(truths), reduction="none")  # (K, 8)
    weights = [config.offset_weight] * 2 + [config.depth_weight] + [config.size_weight] * 3
    weights += [config.rotation_weight] * 2
    box_error = (errors * errors.new_tensor(weights)).sum() / count
    return {"perspective classes": config.weight * classes, "perspective boxes": config.weight * box_error}
