"""A loss on the image features beside those of the heads: every pixel on an object says its class and how far it is.

The heads teach the backbone through the few places at which the BEV queries look; here every object teaches the pixels
in which it appears, directly. (The idea is BEVFormer v2's perspective supervision, arXiv 2211.10439; this is a linear
layer, not a second detector.) The layer that reads the features serves training only.
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


@dataclass(frozen=True)
class ImageLossConfig:
    """weight: of the whole loss; 0 leaves it out, as published. place_weight: of depth and centre in it."""

    weight: float = 0.0
    place_weight: float = 1.0

    def __post_init__(self) -> None:
        if min(self.weight, self.place_weight) < 0:
            raise ValueError("weight and place_weight must not be negative")


@dataclass(frozen=True)
class ImageLoss:
    """Weighted. classes: focal. places: L1 of log depth and of the way to the projected centre."""

    classes: Tensor
    places: Tensor


class ImageFeatureReader(nn.Module):
    """(P, C, h, w) features of P images -> class logits (P, h, w, classes) and places (P, h, w, 3).

    A place is (log of the depth in metres, way to the centre's projection in x, in y, in pixels of the feature map).
    """

    def __init__(self, channels: int, classes: int) -> None:
        super().__init__()
        self.classes = nn.Linear(channels, classes)
        self.places = nn.Linear(channels, 3)
        nn.init.constant_(self.classes.bias, -math.log(99))  # focal prior, as in the detection head

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """features: (P, C, h, w)."""
        pixels = features.movedim(1, -1)
        return self.classes(pixels), self.places(pixels)


def image_loss(
    reader: ImageFeatureReader,
    features: Tensor,
    inputs: BEVFormerInputs,
    targets: Sequence[DetectionTargets],
    config: ImageLossConfig,
    of_boxes: DetectionLossConfig,
) -> ImageLoss:
    """features: (B·N, C, h, w), the finest of the neck's for these inputs. targets: B.

    Both losses are divided by the number of taught pixels; the classes weigh as those of boxes.
    """
    logits, places = reader(features)
    wanted = torch.zeros_like(logits)
    found, truths = [], []
    image_size = (inputs.images.shape[-2], inputs.images.shape[-1])
    cameras = inputs.image_from_bev.shape[1]
    for image, matrix in enumerate(inputs.image_from_bev.flatten(0, 1)):
        truth = targets[image // cameras]
        taught = _taught_pixels(matrix, truth.codes, (features.shape[-2], features.shape[-1]), image_size)
        wanted[image, taught.rows, taught.columns, truth.labels[taught.owners]] = 1
        found.append(places[image, taught.rows, taught.columns])
        truths.append(taught.places)
    count = max(sum(map(len, found)), 1)
    classes = of_boxes.class_weight * focal_loss(logits, wanted).sum() / count
    errors = F.l1_loss(torch.cat(found), torch.cat(truths), reduction="sum") / count
    return ImageLoss(config.weight * classes, config.weight * config.place_weight * errors)


@dataclass(frozen=True)
class _TaughtPixels:
    """K pixels of a feature map. owners: places of their objects. places: (K, 3), what they should say."""

    rows: Tensor
    columns: Tensor
    owners: Tensor
    places: Tensor


def _taught_pixels(
    image_from_bev: Tensor, codes: Tensor, shape: tuple[int, int], image_size: tuple[int, int]
) -> _TaughtPixels:
    """The pixels in the inner half of an object's outline; of objects behind each other, the nearest one's."""
    if not len(codes):
        none = torch.zeros(0, dtype=torch.int64, device=codes.device)
        return _TaughtPixels(none, none, none, codes.new_zeros(0, 3))
    rows, columns = shape
    scale = codes.new_tensor([columns / image_size[1], rows / image_size[0]])
    centers = codes[:, [0, 1, 4]]
    pixels, depth = project_points(image_from_bev, centers)
    ahead = depth > MIN_DEPTH
    middle = pixels * scale  # (G, 2), x and y
    toward = image_from_bev[2, :3]  # the viewing direction
    focal = (image_from_bev[:2, :3].square().sum(1) - (image_from_bev[:2, :3] @ toward).square()).sqrt() * scale
    width = codes[:, [2, 3]].exp().mean(1)
    reach = torch.stack([width, codes[:, 5].exp()], 1) / 4 * focal / depth.clamp(min=MIN_DEPTH)[:, None]
    y, x = torch.meshgrid(
        torch.arange(rows, device=codes.device) + 0.5, torch.arange(columns, device=codes.device) + 0.5, indexing="ij"
    )
    way = middle - torch.stack([x, y], -1)[:, :, None]  # (h, w, G, 2)
    inside = (way.abs() <= reach.clamp(min=0.6)).all(-1) & ahead
    nearest = torch.where(inside, depth, torch.inf).argmin(-1)  # (h, w)
    row, column = inside.any(-1).nonzero(as_tuple=True)
    owners = nearest[row, column]
    places = torch.cat([depth[owners].log()[:, None], way[row, column, owners]], -1)
    return _TaughtPixels(row, column, owners, places)
