"""AdamW with a linear warm-up and a cosine decay of the learning rate, as published."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class OptimizerConfig:
    """The [training.optimizer] table.

    Attributes:
        learning_rate: the peak learning rate.
        backbone_share: learning rate of the image backbone relative to the rest; 1 for an untrained backbone.
        weight_decay: of AdamW.
        warm_up_steps: steps in which the rate rises linearly.
        warm_up_start: relative rate at step 0.
        final_share: relative rate at the end of the cosine decay.
        max_gradient_norm: gradients are clipped to this L2 norm.
        average: decay per update of a running average of the weights, such as 0.998; 0 for none. The average is what is
            evaluated and released, so that a training may end before its learning rate has decayed.
    """

    learning_rate: float = 2e-4
    backbone_share: float = 0.1
    weight_decay: float = 0.01
    warm_up_steps: int = 500
    warm_up_start: float = 1 / 3
    final_share: float = 1e-3
    max_gradient_norm: float = 35.0
    average: float = 0.0

    def __post_init__(self) -> None:
        if min(self.learning_rate, self.max_gradient_norm) <= 0 or self.warm_up_steps < 0:
            raise ValueError("learning_rate and max_gradient_norm must be positive, warm_up_steps not negative")
        if not 0 <= self.average < 1:
            raise ValueError("average must be from 0 to below 1")

    def learning_rate_at(self, step: int, steps: int) -> float:
        """The learning rate of a step (0 to steps - 1)."""
        cosine = (1 + math.cos(math.pi * step / steps)) / 2
        share = self.final_share + (1 - self.final_share) * cosine
        if step < self.warm_up_steps:
            share *= self.warm_up_start + (1 - self.warm_up_start) * step / self.warm_up_steps
        return self.learning_rate * share


def make_optimizer(trained: nn.Module, backbone: nn.Module, config: OptimizerConfig) -> torch.optim.AdamW:
    """AdamW with two parameter groups: everything in `trained` except the backbone, and the backbone.

    Frozen parameters get no gradient, so that it leaves them alone.
    """
    in_backbone = {id(parameter) for parameter in backbone.parameters()}
    others = [parameter for parameter in trained.parameters() if id(parameter) not in in_backbone]
    groups = [{"params": others, "share": 1.0}, {"params": list(backbone.parameters()), "share": config.backbone_share}]
    return torch.optim.AdamW(groups, lr=config.learning_rate, weight_decay=config.weight_decay)


def set_learning_rate(optimizer: torch.optim.AdamW, rate: float) -> None:
    """Sets the learning rate of the next step; each parameter group takes its share of it."""
    for group in optimizer.param_groups:
        group["lr"] = rate * group["share"]


@torch.no_grad()
def update_average(average: dict[str, Tensor], state: Mapping[str, Tensor], decay: float) -> None:
    """Moves a running average of a state dict towards it, in place; integers are copied."""
    for key, value in state.items():
        if value.is_floating_point():
            average[key].lerp_(value, 1 - decay)
        else:
            average[key].copy_(value)


def clip_gradients(module: nn.Module, max_norm: float) -> float:
    """Clips the gradient to an L2 norm of at most max_norm; returns its norm before."""
    return float(nn.utils.clip_grad_norm_(module.parameters(), max_norm))
