"""All losses of a frame, and what exists in training only: auxiliary heads, and a teacher."""

import contextlib
import copy
import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from bevcli.checkpoints import load_weights
from bevcli.config import load_config
from bevcli.errors import ConfigError
from bevcli.geometry.bev_grid import BevGrid
from bevcli.inference.load import weights_file
from bevcli.model.config import ModelConfig
from bevcli.model.decoder import BOX_CODE_SIZE
from bevcli.model.kernels.choose import choose_kernels
from bevcli.model.network import Network, build_network
from bevcli.model.step import ModelInputs, ModelOutputs
from bevcli.workshop.training.augmentation import renormalised
from bevcli.workshop.training.clip_steps import clip_steps
from bevcli.workshop.training.detection_loss import (
    AnyTargets,
    DetectionLossConfig,
    PaddedTargets,
    assigned_loss,
    detection_loss,
    layer_matches,
    padded,
)
from bevcli.workshop.training.perspective_loss import PerspectiveHead, PerspectiveLossConfig, perspective_loss
from bevcli.workshop.training.samples import Batch, Targets, own_heads
from bevcli.workshop.training.segmentation_loss import SegmentationLossConfig, segmentation_loss


@dataclass(frozen=True)
class DenseLossConfig:
    """The [training.dense_loss] table.

    Attributes:
        weight: of the whole loss; 0 disables it, as published.
        reach_m: cells up to this distance from an object's centre are positives, metres.
    """

    weight: float = 0.0
    reach_m: float = 1.5

    def __post_init__(self) -> None:
        if self.weight < 0 or self.reach_m <= 0:
            raise ValueError("weight must not be negative, reach_m must be positive")


class DenseHead(nn.Module):
    """One linear layer that predicts classes and a box from each BEV cell."""

    centers: Tensor

    def __init__(self, channels: int, classes: int, grid: BevGrid) -> None:
        super().__init__()
        self.classes = nn.Linear(channels, classes)
        self.boxes = nn.Linear(channels, BOX_CODE_SIZE)
        nn.init.constant_(self.classes.bias, -math.log(99))  # focal prior, as in the detection head
        centers = torch.as_tensor(grid.cell_centers(), dtype=torch.float32).reshape(-1, 2)
        self.register_buffer("centers", centers, persistent=False)

    def forward(self, bev: Tensor) -> tuple[Tensor, Tensor]:
        """bev: (B, Y·X, C) -> class logits (B, Y·X, classes) and box codes (B, Y·X, 10).

        The layer predicts a box centre as an offset from the cell's centre, metres.
        """
        codes = self.boxes(bev)
        return self.classes(bev), torch.cat([codes[..., :2] + self.centers, codes[..., 2:]], dim=-1)


def dense_loss(
    head: DenseHead, bev: Tensor, targets: AnyTargets, config: DenseLossConfig, detection: DetectionLossConfig
) -> dict[str, Tensor]:
    """Focal loss of all cells and L1 loss of the positive ones, divided by the number of positive cells.

    bev: (B, Y·X, C). targets: B. detection: the weights of classes and boxes, as in the detection loss.
    """
    truth = padded(targets)
    logits, codes = head(bev)
    objects = _objects_in_reach(head.centers, truth, config.reach_m)
    classes, boxes = config.weight * assigned_loss(logits, codes, truth, objects, detection)
    return {"cell classes": classes, "cell boxes": boxes}


def _objects_in_reach(cells: Tensor, truth: PaddedTargets, reach_m: float) -> Tensor:
    """(B, Y·X) int64 the nearest object of each cell that is within reach of it, -1 for none.

    cells: (Y·X, 2) centres, metres.
    """
    # Not by a product of matrices, which a GPU may round.
    distances = torch.cdist(cells, truth.codes[..., :2], compute_mode="donot_use_mm_for_euclid_dist")
    distance, nearest = distances.where(truth.exists[:, None], torch.inf).min(dim=-1)
    return nearest.where(distance <= reach_m, -1)


@dataclass(frozen=True)
class DistillationLossConfig:
    """The [training.distillation_loss] table.

    Attributes:
        weight: of the mean squared difference of the BEV maps; 0 disables this part.
        feature_weight: of the mean squared difference of the neck's maps, relative to the variance of the teacher's; 0
            disables this part. With it the teacher sees the images that the model sees, with all augmentation.
        teacher: weights of the teacher, a file or a model's name.
        model: name or TOML file of the teacher's model, which may have another backbone and normalisation of images;
            "" for the model that is trained.
    """

    weight: float = 0.0
    feature_weight: float = 0.0
    teacher: str = ""
    model: str = ""

    def __post_init__(self) -> None:
        if min(self.weight, self.feature_weight) < 0 or (self.active and not self.teacher):
            raise ValueError(
                "weight and feature_weight must not be negative, and teacher must name weights where one is positive"
            )

    @property
    def active(self) -> bool:
        """Some part of the loss is not disabled."""
        return max(self.weight, self.feature_weight) > 0


@dataclass(frozen=True)
class Lesson:
    """The results of a teacher for one frame of B clips with N cameras.

    Attributes:
        bev: (B, Y·X, C) float32; None where only the features are learned.
        features: (B·N, C, H, W) float32 of each level of the neck; empty where only the BEV map is learned.
    """

    bev: Tensor | None
    features: tuple[Tensor, ...]


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

    @torch.no_grad()
    def lessons(self, clip: Batch) -> Iterator[Lesson]:
        """The results for each frame of clips, lazily."""
        image, own, network = self._taught.image, self._network.config.image, self._network
        steps, memory = clip_steps(network), None
        if image != own:
            clip = replace(
                clip, inputs=tuple(replace(x, images=renormalised(x.images, image, own)) for x in clip.inputs)
            )
        for frame, inputs in enumerate(clip.inputs):
            bev = None
            with last_outputs(network.neck) as features:
                if self._config.weight:
                    outputs, memory = steps.outputs(clip, frame, memory)
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
def last_outputs(part: nn.Module) -> Iterator[deque[Any]]:
    """Inside, the only item is what the last forward pass of a part returned. No hook remains."""
    kept = deque[Any](maxlen=1)
    hook = part.register_forward_hook(lambda part, inputs, outputs: kept.append(outputs))
    try:
        yield kept
    finally:
        hook.remove()


@dataclass(frozen=True)
class LossConfigs:
    """The tables of [training] whose names end in _loss.

    Attributes:
        detection_loss: the detection head's.
        segmentation_loss: the segmentation head's, where the model has one.
        dense_loss: auxiliary, on the BEV map.
        perspective_loss: auxiliary, on the image features.
        distillation_loss: auxiliary, against the BEV map or the image features of a teacher.
    """

    detection_loss: DetectionLossConfig = field(default_factory=DetectionLossConfig)
    segmentation_loss: SegmentationLossConfig = field(default_factory=SegmentationLossConfig)
    dense_loss: DenseLossConfig = field(default_factory=DenseLossConfig)
    perspective_loss: PerspectiveLossConfig = field(default_factory=PerspectiveLossConfig)
    distillation_loss: DistillationLossConfig = field(default_factory=DistillationLossConfig)


class FrameLosses:
    """Computes the losses of one forward pass by name.

    Attributes:
        auxiliary_heads: the heads of the dense and the perspective loss, which train along with the model. Their names
            are part of the checkpoint format.
    """

    def __init__(self, model: Network, configs: LossConfigs) -> None:
        classes = len(model.config.classes)
        self.configs = configs
        self._config, self._own_heads = model.config, own_heads(model.config)
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
        logits, codes, weights = outputs.class_logits, outputs.box_codes, self.configs.detection_loss
        losses = detection_loss(logits, codes, targets.detection, weights, self._query_groups)
        if self._dense_head is not None:
            bev, config = outputs.bev.float(), self.configs.dense_loss
            losses |= dense_loss(self._dense_head, bev, targets.detection, config, weights)
        if self._perspective_head is not None:
            losses |= perspective_loss(
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
            losses |= {"distillation": self.configs.distillation_loss.weight * difference}
        if taught is not None and taught.features:
            pairs = zip(self._feature_maps[0], taught.features, strict=True)
            shares = [nn.functional.mse_loss(own.float(), other) / other.var() for own, other in pairs]
            losses |= {"features": self.configs.distillation_loss.feature_weight * torch.stack(shares).mean()}
        if self._own_heads is not None:
            matches = layer_matches(logits[-1], codes[-1], targets.detection, weights)
            losses |= self._own_heads.losses(outputs, targets.truths, matches, self._config)
        if outputs.segmentation is not None and targets.segmentation is not None:
            losses |= segmentation_loss(outputs.segmentation, targets.segmentation, self.configs.segmentation_loss)
        return losses
