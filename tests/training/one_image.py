"""Perspective targets of a single image, sparse."""

from dataclasses import dataclass

import torch

from bevcli.workshop.training.frame_losses import FeatureLocations, ImageObjects, perspective_targets, project_objects
from bevcli.workshop.training.targets import DetectionTargets, padded


@dataclass(frozen=True)
class ImageTargets:
    """The K positive locations of an image, their classes and box numbers, and which of all locations are ignored."""

    locations: torch.Tensor
    labels: torch.Tensor
    boxes: torch.Tensor
    ignored: torch.Tensor


def targets_of_image(
    image_from_bev: torch.Tensor, truth: DetectionTargets, locations: FeatureLocations, size: tuple[int, int]
) -> ImageTargets:
    found = perspective_targets(image_from_bev[None], padded([truth]), locations, size)
    positive = found.positive[0]
    return ImageTargets(positive.nonzero()[:, 0], found.labels[0, positive], found.boxes[0, positive], found.ignored[0])


def objects_of_image(image_from_bev: torch.Tensor, codes: torch.Tensor, size: tuple[int, int]) -> ImageObjects:
    objects = project_objects(image_from_bev[None], codes[None], size)
    return ImageObjects(**{name: part[0] for name, part in vars(objects).items()})
