"""Perspective supervision (BEVFormerV2, Yang et al. 2023): the loss of the perspective head.

The detection head trains the image backbone only through the sampling points of the BEV queries. Here each box trains
the features of the pixels that show it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from bevcli.training.detection_targets import DetectionTargets
from bevcli.training.focal_loss import focal_loss
from bevcli.training.perspective_head import PerspectiveHead
from bevcli.training.perspective_targets import BOX_NUMBERS, feature_locations, perspective_targets


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
        weights = (self.class_weight, self.offset_weight, self.depth_weight, self.size_weight, self.rotation_weight)
        if min(self.weight, self.layers, *weights) < 0:
            raise ValueError("layers and the weights must not be negative")


@dataclass(frozen=True)
class PerspectiveLoss:
    """Weighted scalar losses.

    Attributes:
        classes: () focal loss of the classes.
        boxes: () L1 loss of offset, depth, size and rotation.
    """

    classes: Tensor
    boxes: Tensor


def perspective_loss(
    head: PerspectiveHead,
    feature_maps: Sequence[Tensor],
    image_from_bev: Tensor,
    has_image: Tensor,
    image_size: tuple[int, int],
    targets: Sequence[DetectionTargets],
    config: PerspectiveLossConfig,
) -> PerspectiveLoss:
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
    return PerspectiveLoss(config.weight * classes, config.weight * box_error)
