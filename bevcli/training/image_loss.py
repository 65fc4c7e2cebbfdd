"""Auxiliary loss on the image features: every pixel on an object predicts its class, depth and projected centre.

The detection head trains the backbone only through the sampling points of the BEV queries. Here each object trains the
pixels that show it directly. The idea is the perspective supervision of BEVFormer v2 (arXiv 2211.10439), with a linear
layer in place of a second detector. The auxiliary head exists in training only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.model.bevformer import BEVFormerInputs
from bevcli.model.pillar_projection import MIN_DEPTH, project_points
from bevcli.training.detection_loss import DetectionLossConfig
from bevcli.training.detection_targets import DetectionTargets
from bevcli.training.focal_loss import focal_loss

MIN_HALF_EXTENT = 0.6  # feature pixels; a smaller object still covers the centre of at least one pixel


@dataclass(frozen=True)
class ImageLossConfig:
    """The [training.picture_loss] table.

    Attributes:
        weight: of the whole loss; 0 disables it, as published.
        place_weight: of depth and projected centre within the loss.
    """

    weight: float = 0.0
    place_weight: float = 1.0

    def __post_init__(self) -> None:
        if min(self.weight, self.place_weight) < 0:
            raise ValueError("weight and place_weight must not be negative")


@dataclass(frozen=True)
class ImageLoss:
    """Weighted scalar losses.

    Attributes:
        classes: () focal loss of the classes.
        places: () L1 loss of log depth and of the offset to the projected centre.
    """

    classes: Tensor
    places: Tensor


class ImageHead(nn.Module):
    """One linear layer that predicts classes and the place of an object from each pixel of the image features."""

    def __init__(self, channels: int, classes: int) -> None:
        super().__init__()
        self.classes = nn.Linear(channels, classes)
        self.places = nn.Linear(channels, 3)
        nn.init.constant_(self.classes.bias, -math.log(99))  # focal prior, as in the detection head

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """features: (P, C, h, w) of P images -> class logits (P, h, w, classes) and places (P, h, w, 3).

        A place is the log of the depth in metres, and the offset from the pixel to the projection of the object's
        centre in x and y, in pixels of the feature map.
        """
        pixels = features.movedim(1, -1)
        return self.classes(pixels), self.places(pixels)


def image_loss(
    head: ImageHead,
    features: Tensor,
    inputs: BEVFormerInputs,
    targets: Sequence[DetectionTargets],
    config: ImageLossConfig,
    detection: DetectionLossConfig,
) -> ImageLoss:
    """Focal loss of all pixels and L1 loss of the positive ones, divided by the number of positive pixels.

    Args:
        features: (B·N, C, h, w) the neck's finest feature map for these inputs.
        targets: B.
        detection: its class weight applies here too.
    """
    logits, places = head(features)
    class_targets = torch.zeros_like(logits)
    predicted, truths = [], []
    image_size = (inputs.images.shape[-2], inputs.images.shape[-1])
    cameras = inputs.image_from_bev.shape[1]
    for image, matrix in enumerate(inputs.image_from_bev.flatten(0, 1)):
        truth = targets[image // cameras]
        positive = _positive_pixels(matrix, truth.codes, (features.shape[-2], features.shape[-1]), image_size)
        class_targets[image, positive.rows, positive.columns, truth.labels[positive.objects]] = 1
        predicted.append(places[image, positive.rows, positive.columns])
        truths.append(positive.places)
    count = max(sum(map(len, predicted)), 1)
    classes = detection.class_weight * focal_loss(logits, class_targets).sum() / count
    errors = F.l1_loss(torch.cat(predicted), torch.cat(truths), reduction="sum") / count
    return ImageLoss(config.weight * classes, config.weight * config.place_weight * errors)


@dataclass(frozen=True)
class _PositivePixels:
    """K pixels of a feature map that show an object.

    Attributes:
        rows: (K,) int64.
        columns: (K,) int64.
        objects: (K,) int64, indices of the objects that they show.
        places: (K, 3) targets, as `ImageHead` predicts them.
    """

    rows: Tensor
    columns: Tensor
    objects: Tensor
    places: Tensor


def _positive_pixels(
    image_from_bev: Tensor, codes: Tensor, shape: tuple[int, int], image_size: tuple[int, int]
) -> _PositivePixels:
    """The pixels in the inner half of an object's outline. Where objects overlap, a pixel shows the nearest.

    Args:
        image_from_bev: (4, 4).
        codes: (G, 10) box codes.
        shape: rows and columns of the feature map.
        image_size: height and width of the network's input image, pixels.
    """
    if not len(codes):
        none = torch.zeros(0, dtype=torch.int64, device=codes.device)
        return _PositivePixels(none, none, none, codes.new_zeros(0, 3))
    rows, columns = shape
    scale = codes.new_tensor([columns / image_size[1], rows / image_size[0]])
    centers = codes[:, [0, 1, 4]]
    pixels, depth = project_points(image_from_bev, centers)
    in_front = depth > MIN_DEPTH
    projected = pixels * scale  # (G, 2), x and y
    viewing_direction = image_from_bev[2, :3]
    focal = (image_from_bev[:2, :3].square().sum(1) - (image_from_bev[:2, :3] @ viewing_direction).square()).sqrt()
    width, height = codes[:, [2, 3]].exp().mean(1), codes[:, 5].exp()
    half_extent = torch.stack([width, height], 1) / 4 * (focal * scale) / depth.clamp(min=MIN_DEPTH)[:, None]
    y, x = torch.meshgrid(
        torch.arange(rows, device=codes.device) + 0.5, torch.arange(columns, device=codes.device) + 0.5, indexing="ij"
    )
    offset = projected - torch.stack([x, y], -1)[:, :, None]  # (h, w, G, 2)
    inside = (offset.abs() <= half_extent.clamp(min=MIN_HALF_EXTENT)).all(-1) & in_front
    nearest = torch.where(inside, depth, torch.inf).argmin(-1)  # (h, w)
    row, column = inside.any(-1).nonzero(as_tuple=True)
    objects = nearest[row, column]
    places = torch.cat([depth[objects].log()[:, None], offset[row, column, objects]], -1)
    return _PositivePixels(row, column, objects, places)
