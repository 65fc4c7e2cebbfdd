"""All that a frame's outputs cost, and the layers that read the model in training only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor, nn

from bevcli.model.bevformer import BEVFormer, BEVFormerInputs, BEVFormerOutputs
from bevcli.training.dense_loss import DenseLossConfig, DenseReader, dense_loss
from bevcli.training.detection_loss import DetectionLossConfig, detection_loss
from bevcli.training.image_loss import ImageFeatureReader, ImageLossConfig, image_loss
from bevcli.training.samples import Targets
from bevcli.training.segmentation_loss import SegmentationLossConfig, segmentation_loss


@dataclass(frozen=True)
class LossConfigs:
    """Those tables of [training] that end in _loss."""

    detection_loss: DetectionLossConfig = field(default_factory=DetectionLossConfig)
    segmentation_loss: SegmentationLossConfig = field(default_factory=SegmentationLossConfig)
    dense_loss: DenseLossConfig = field(default_factory=DenseLossConfig)
    picture_loss: ImageLossConfig = field(default_factory=ImageLossConfig)


class FrameLosses:
    """`losses(inputs, outputs, targets)`, called right after the model's forward that it judges.

    readers: the layers of the dense and the image loss, which learn along with the model.
    """

    def __init__(self, model: BEVFormer, configs: LossConfigs) -> None:
        of_model, classes = model.config, len(model.config.classes)
        self.configs = configs
        self.groups = of_model.decoder.training_groups
        self.dense_reader: DenseReader | None = None
        self.image_reader: ImageFeatureReader | None = None
        self.readers = nn.ModuleDict()
        if configs.dense_loss.weight > 0:
            self.dense_reader = DenseReader(of_model.channels, classes, of_model.bev_grid)
            self.readers["dense_reader"] = self.dense_reader
        if configs.picture_loss.weight > 0:
            self.image_reader = ImageFeatureReader(of_model.channels, classes)
            self.readers["image_reader"] = self.image_reader
            model.neck.register_forward_hook(self._keep_features)

    def __call__(self, inputs: BEVFormerInputs, outputs: BEVFormerOutputs, targets: Targets) -> dict[str, Tensor]:
        """The weighted losses by name; their sum is what a step makes smaller."""
        of_boxes = self.configs.detection_loss
        detection = detection_loss(outputs.class_logits, outputs.box_codes, targets.detection, of_boxes, self.groups)
        losses = {"classes": detection.classes, "boxes": detection.boxes}
        if self.dense_reader is not None:
            bev, config = outputs.bev.float(), self.configs.dense_loss
            dense = dense_loss(self.dense_reader, bev, targets.detection, config, of_boxes)
            losses |= {"cell classes": dense.classes, "cell boxes": dense.boxes}
        if self.image_reader is not None:
            features, of_pixels = self._features.float(), self.configs.picture_loss
            pixels = image_loss(self.image_reader, features, inputs, targets.detection, of_pixels, of_boxes)
            losses |= {"pixel classes": pixels.classes, "pixel places": pixels.places}
        if outputs.segmentation is not None:
            maps = segmentation_loss(outputs.segmentation, targets.segmentation, self.configs.segmentation_loss)
            losses |= {"map classes": maps.classes, "masks": maps.masks, "locations": maps.locations}
        return losses

    def _keep_features(self, neck: nn.Module, inputs: tuple[Any, ...], maps: Sequence[Tensor]) -> None:
        """The finest of the neck's maps, which the image loss reads."""
        self._features = maps[0]
