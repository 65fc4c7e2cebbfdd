"""An image backbone: what its kinds share, and what the rest of a model knows of one."""

from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import Protocol

from torch import Tensor, nn


class BackboneConfig(Protocol):
    """The table [backbone] of a model file, of any kind. Its field `kind` chooses the dataclass.

    Attributes:
        kind: name of the kind.
        title: the kind in words.
        output_stages: the stages, from 1, whose maps go to the neck.
    """

    @property
    def kind(self) -> str: ...
    @property
    def title(self) -> str: ...
    @property
    def output_stages(self) -> tuple[int, ...]: ...

    def output_channels(self) -> tuple[int, ...]:
        """Channels of the map of each output stage."""

    def output_strides(self) -> tuple[int, ...]:
        """Pixels of the image per cell of the map of each output stage."""

    def stage_names(self) -> Iterator[str]:
        """Each stage that the model has, in words."""

    def build(self) -> "Backbone":
        """The backbone, with random weights."""


class Backbone(nn.Module):
    """Images to feature maps of the configured output stages. A subclass makes `conv1`, `bn1` and the stages.

    Attributes:
        output_stages: the stages, from 1, whose maps are returned.
        conv1: the convolution of the stem.
        bn1: the batch norm after it.
        stages: from the first to the last one whose map is returned.
        frozen_stages: so many first stages, and the stem, keep their weights and statistics in a training.
        frozen_maps: computes the maps of the first stages in place of the stem and these stages, during a training
            that keeps their weights.
    """

    conv1: nn.Conv2d
    bn1: nn.BatchNorm2d
    stages: nn.ModuleList

    def __init__(self, output_stages: tuple[int, ...]) -> None:
        super().__init__()
        self.output_stages = output_stages
        self.frozen_stages = 0
        self.frozen_maps: Callable[[Tensor], list[Tensor]] | None = None

    @abstractmethod
    def stem(self, images: Tensor) -> Tensor:
        """images: (B, 3, H, W) -> the input of the first stage."""

    def freeze(self, stages: int) -> None:
        """Keeps the stem and so many first stages as they are in a training; with 0 nothing is frozen."""
        self.frozen_stages = stages
        for part in [self.conv1, self.bn1, *self.stages[:stages]] if stages else ():
            part.requires_grad_(False)

    def train(self, mode: bool = True) -> "Backbone":
        """As `nn.Module.train`; batch norms of frozen parts stay in evaluation mode."""
        super().train(mode)
        for part in [self.conv1, self.bn1, *self.stages[: self.frozen_stages]] if self.frozen_stages else ():
            part.eval()
        return self

    def forward(self, images: Tensor) -> list[Tensor]:
        """images: (B, 3, H, W), H and W multiples of 32 -> (B, C_s, H / stride, W / stride) for each output stage."""
        maps: list[Tensor] = []
        if self.frozen_maps is not None:
            maps = self.frozen_maps(images)
        x = maps[-1] if maps else self.stem(images)
        for blocks in self.stages[len(maps) :]:
            x = blocks(x)
            maps.append(x)
        return [maps[stage - 1] for stage in self.output_stages]
