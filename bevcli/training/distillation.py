"""Distillation: the BEV maps of a teacher, which sees the images and the calibration before they were augmented."""

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bevcli.checkpoints import load_weights
from bevcli.model.kernels.choose import choose_kernels
from bevcli.model.network import Network
from bevcli.model.step import ClipInputs
from bevcli.weights.fetch import weights_file


@dataclass(frozen=True)
class DistillationLossConfig:
    """The [training.distillation_loss] table.

    Attributes:
        weight: of the mean squared difference of the BEV maps; 0 disables the loss.
        teacher: weights of the same model, a file or a model's name.
    """

    weight: float = 0.0
    teacher: str = ""

    def __post_init__(self) -> None:
        if self.weight < 0 or (self.weight > 0 and not self.teacher):
            raise ValueError("weight must not be negative, and teacher must name weights where it is positive")


class Teacher:
    """A copy of a model with the teacher's weights, in evaluation mode."""

    def __init__(self, model: Network, weights: str, device: torch.device) -> None:
        """Raises WeightsError where the weights are missing or do not fit the model."""
        self._network = copy.deepcopy(model)
        load_weights(weights_file(Path(weights)), self._network)
        self._network.eval().requires_grad_(False).to(device)
        choose_kernels(self._network, device)

    def bev_maps(self, clip: ClipInputs) -> Iterator[Tensor]:
        """The BEV map (B, Y·X, C) of each frame of clips that are not augmented."""
        memory: Any = None
        for place in range(len(clip.inputs)):
            with torch.no_grad():
                outputs, memory = self._network.learn(clip, place, memory)
            yield outputs.bev.float()
