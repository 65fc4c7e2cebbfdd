"""Forward passes through training clips: of the model, frame by frame, of its frozen stages, and of a teacher."""

import contextlib
import copy
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from bevcli.checkpoints import load_weights
from bevcli.config import load_config
from bevcli.errors import ConfigError
from bevcli.inference.load import weights_file
from bevcli.model.backbone import Backbone
from bevcli.model.config import ModelConfig
from bevcli.model.kernels.choose import choose_kernels, fold_batch_norms
from bevcli.model.kernels.gpu import find_hits_on_cpu
from bevcli.model.kernels.onednn import use_onednn
from bevcli.model.network import Network, build_network
from bevcli.model.step import ModelOutputs
from bevcli.workshop.training.augmentation import renormalised
from bevcli.workshop.training.samples import Batch


def forward_clip(
    model: Network, batch: Batch, *, learn_all: bool = False, freeze_batch_norm: bool = False
) -> Iterator[ModelOutputs]:
    """The outputs, in training mode, for the last frame of a batch of clips.

    The frames before it only build its history, in evaluation mode and without gradient, as in the papers. Of a model
    with a window of frames, this applies to the image features of the earlier frames.

    Args:
        learn_all: yield the outputs for every frame. The model may be updated in between: history has no gradient.
        freeze_batch_norm: keep batch norms in evaluation mode, for fine-tuning.
    """
    frames = len(batch.inputs)
    first_learned = 0 if learn_all else frames - 1
    memory = None
    model.eval()
    with torch.no_grad():
        for frame in range(first_learned):
            memory = model.history_of_clip(batch, frame, memory)
    model.train()
    for module in model.modules():
        if freeze_batch_norm and isinstance(module, nn.BatchNorm2d):
            module.eval()
    for frame in range(first_learned, frames):
        outputs, memory = model.outputs_of_clip(batch, frame, memory)
        yield outputs


class FrozenStages:
    """A copy of the stem and the first stages of a backbone, computed as in inference: faster, the same results.

    Batch norms are folded into their convolutions and, on a CPU, oneDNN runs the residual blocks, one image at a time,
    whose feature maps fit into the caches.
    """

    def __init__(self, backbone: Backbone, stages: int, dtype: torch.dtype) -> None:
        """stages: how many, from the first. dtype: of the computation and its results."""
        self._device = next(backbone.parameters()).device
        self._dtype = dtype
        part = copy.deepcopy(backbone)
        part.stages = nn.ModuleList(part.stages[:stages])
        part.output_stages = tuple(range(1, len(part.stages) + 1))
        part.eval().requires_grad_(False)
        fold_batch_norms(part, self._device)
        part.to(dtype, memory_format=torch.channels_last)  # type: ignore[call-overload]
        if self._device.type == "cpu":
            use_onednn(part)
        self._part = part

    @contextlib.contextmanager
    def used_by(self, backbone: Backbone) -> Iterator[None]:
        """Inside, the backbone takes the maps of its first stages from here."""
        backbone.frozen_maps = self._maps
        try:
            yield
        finally:
            backbone.frozen_maps = None

    @torch.no_grad()
    def _maps(self, images: Tensor) -> list[Tensor]:
        """images: (B, 3, H, W) -> the map of each stage, without gradient."""
        with torch.autocast(self._device.type, enabled=False):
            images = images.to(self._dtype).contiguous(memory_format=torch.channels_last)
            if self._device.type != "cpu":
                return list(self._part(images))
            maps_of_images = [self._part(image) for image in images.split(1)]
            return [torch.cat(maps) for maps in zip(*maps_of_images, strict=True)]


@dataclass(frozen=True)
class DistillationLossConfig:
    """The [training.distillation_loss] table."""

    weight: float = 0.0  # of the mean squared difference of the BEV maps; 0 disables this part
    feature_weight: float = 0.0  # of that of the neck's maps, by the teacher's variance; it then sees augmented images
    teacher: str = ""  # weights of the teacher, a file or a model's name
    model: str = ""  # name or TOML file of the teacher's model; "" for the model that is trained

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
