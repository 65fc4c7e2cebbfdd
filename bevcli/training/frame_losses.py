"""All losses of a frame, and the auxiliary heads that exist in training only."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor, nn

from bevcli.model.bevformer import BEVFormer, BEVFormerInputs, BEVFormerOutputs
from bevcli.training.dense_loss import DenseHead, DenseLossConfig, dense_loss
from bevcli.training.detection_loss import DetectionLossConfig, detection_loss
from bevcli.training.image_loss import ImageHead, ImageLossConfig, image_loss
from bevcli.training.samples import Targets
from bevcli.training.segmentation_loss import SegmentationLossConfig, segmentation_loss


@dataclass(frozen=True)
class LossConfigs:
    """The tables of [training] whose names end in _loss.

    Attributes:
        detection_loss: the detection head's.
        segmentation_loss: the segmentation head's, where the model has one.
        dense_loss: auxiliary, on the BEV map.
        picture_loss: auxiliary, on the image features (the key in the file keeps this name).
    """

    detection_loss: DetectionLossConfig = field(default_factory=DetectionLossConfig)
    segmentation_loss: SegmentationLossConfig = field(default_factory=SegmentationLossConfig)
    dense_loss: DenseLossConfig = field(default_factory=DenseLossConfig)
    picture_loss: ImageLossConfig = field(default_factory=ImageLossConfig)


class FrameLosses:
    """Computes the losses of one forward pass by name.

    Attributes:
        auxiliary_heads: the heads of the dense and the image loss, which train along with the model. Their names are
            part of the checkpoint format.
    """

    def __init__(self, model: BEVFormer, configs: LossConfigs) -> None:
        classes = len(model.config.classes)
        self.configs = configs
        self._query_groups = model.config.decoder.training_groups
        self._dense_head: DenseHead | None = None
        self._image_head: ImageHead | None = None
        self.auxiliary_heads = nn.ModuleDict()
        if configs.dense_loss.weight > 0:
            self._dense_head = DenseHead(model.config.channels, classes, model.config.bev_grid)
            self.auxiliary_heads["dense_reader"] = self._dense_head
        if configs.picture_loss.weight > 0:
            self._image_head = ImageHead(model.config.channels, classes)
            self.auxiliary_heads["picture_reader"] = self._image_head

    @contextlib.contextmanager
    def watching(self, model: BEVFormer) -> Iterator[None]:
        """Inside, each forward pass of the model keeps its image features for the image loss. Leaves no hook behind."""
        if self._image_head is None:
            yield
            return

        def keep(neck: nn.Module, inputs: tuple[Any, ...], maps: Sequence[Tensor]) -> None:
            self._image_features = maps[0]  # the finest level

        hook = model.neck.register_forward_hook(keep)
        try:
            yield
        finally:
            hook.remove()

    def __call__(self, inputs: BEVFormerInputs, outputs: BEVFormerOutputs, targets: Targets) -> dict[str, Tensor]:
        """The weighted scalar losses by name; their sum is minimised.

        Call it inside `watching`, right after the forward pass that made the outputs.
        """
        weights = self.configs.detection_loss
        detection = detection_loss(
            outputs.class_logits, outputs.box_codes, targets.detection, weights, self._query_groups
        )
        losses = {"classes": detection.classes, "boxes": detection.boxes}
        if self._dense_head is not None:
            bev, config = outputs.bev.float(), self.configs.dense_loss
            dense = dense_loss(self._dense_head, bev, targets.detection, config, weights)
            losses |= {"cell classes": dense.classes, "cell boxes": dense.boxes}
        if self._image_head is not None:
            features = self._image_features.float()
            image_config = self.configs.picture_loss
            image = image_loss(self._image_head, features, inputs, targets.detection, image_config, weights)
            losses |= {"pixel classes": image.classes, "pixel places": image.places}
        if outputs.segmentation is not None:
            maps = segmentation_loss(outputs.segmentation, targets.segmentation, self.configs.segmentation_loss)
            losses |= {"map classes": maps.classes, "masks": maps.masks, "locations": maps.locations}
        return losses
