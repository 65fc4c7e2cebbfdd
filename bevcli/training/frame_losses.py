"""All losses of a frame, and the auxiliary heads that exist in training only."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from torch import Tensor, nn

from bevcli.model.bevformer import BEVFormerBase, BEVFormerInputs, BEVFormerOutputs
from bevcli.training.dense_loss import DenseHead, DenseLossConfig, dense_loss
from bevcli.training.detection_loss import DetectionLossConfig, detection_loss
from bevcli.training.perspective_head import PerspectiveHead
from bevcli.training.perspective_loss import PerspectiveLossConfig, perspective_loss
from bevcli.training.samples import Targets
from bevcli.training.segmentation_loss import SegmentationLossConfig, segmentation_loss


@dataclass(frozen=True)
class LossConfigs:
    """The tables of [training] whose names end in _loss.

    Attributes:
        detection_loss: the detection head's.
        segmentation_loss: the segmentation head's, where the model has one.
        dense_loss: auxiliary, on the BEV map.
        perspective_loss: auxiliary, on the image features.
        RENAMED_KEYS: tables of earlier versions, and what replaces them.
    """

    detection_loss: DetectionLossConfig = field(default_factory=DetectionLossConfig)
    segmentation_loss: SegmentationLossConfig = field(default_factory=SegmentationLossConfig)
    dense_loss: DenseLossConfig = field(default_factory=DenseLossConfig)
    perspective_loss: PerspectiveLossConfig = field(default_factory=PerspectiveLossConfig)

    RENAMED_KEYS: ClassVar[Mapping[str, str]] = {
        "picture_loss": "[training.perspective_loss] replaces it, with other keys (docs/training.md)"
    }


class FrameLosses:
    """Computes the losses of one forward pass by name.

    Attributes:
        auxiliary_heads: the heads of the dense and the perspective loss, which train along with the model. Their names
            are part of the checkpoint format.
    """

    def __init__(self, model: BEVFormerBase, configs: LossConfigs) -> None:
        classes = len(model.config.classes)
        self.configs = configs
        self._query_groups = model.config.decoder.training_groups
        self._dense_head: DenseHead | None = None
        self._perspective_head: PerspectiveHead | None = None
        self.auxiliary_heads = nn.ModuleDict()
        if configs.dense_loss.weight > 0:
            self._dense_head = DenseHead(model.config.channels, classes, model.config.bev_grid)
            self.auxiliary_heads["dense_reader"] = self._dense_head
        if configs.perspective_loss.weight > 0:
            self._perspective_head = PerspectiveHead(model.config.channels, classes, configs.perspective_loss.layers)
            self.auxiliary_heads["perspective_head"] = self._perspective_head

    @contextlib.contextmanager
    def watching(self, model: BEVFormerBase) -> Iterator[None]:
        """Inside, each forward pass of the model keeps its image features for the perspective loss. No hook remains."""
        if self._perspective_head is None:
            yield
            return

        def keep(neck: nn.Module, inputs: tuple[Any, ...], maps: Sequence[Tensor]) -> None:
            self._feature_maps = maps

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
        if self._perspective_head is not None:
            perspective = perspective_loss(
                self._perspective_head,
                [features.float() for features in self._feature_maps],
                inputs.image_from_bev,
                inputs.has_image,
                inputs.image_size,
                targets.perspective,
                self.configs.perspective_loss,
            )
            losses |= {"perspective classes": perspective.classes, "perspective boxes": perspective.boxes}
        if outputs.segmentation is not None:
            maps = segmentation_loss(outputs.segmentation, targets.segmentation, self.configs.segmentation_loss)
            losses |= {"map classes": maps.classes, "masks": maps.masks, "locations": maps.locations}
        return losses
