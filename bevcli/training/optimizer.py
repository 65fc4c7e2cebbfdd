"""AdamW with a linear warm-up and a cosine decay, as published."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import nn


@dataclass(frozen=True)
class OptimizerConfig:
    """learning_rate: at its highest. backbone_share: of it, for the image backbone (1 for one that is untrained).

    warm_up_steps: in which the rate rises from warm_up_start of itself. final_share: of the rate, at the end.
    max_gradient_norm: longer gradients are shortened to it.
    """

    learning_rate: float = 2e-4
    backbone_share: float = 0.1
    weight_decay: float = 0.01
    warm_up_steps: int = 500
    warm_up_start: float = 1 / 3
    final_share: float = 1e-3
    max_gradient_norm: float = 35.0

    def __post_init__(self) -> None:
        if min(self.learning_rate, self.max_gradient_norm) <= 0 or self.warm_up_steps < 0:
            raise ValueError("learning_rate and max_gradient_norm must be positive, warm_up_steps not negative")

    def share(self, step: int, steps: int) -> float:
        """The share of the learning rate at a step, 0 to steps - 1."""
        cosine = (1 + math.cos(math.pi * step / steps)) / 2
        decayed = self.final_share + (1 - self.final_share) * cosine
        if step >= self.warm_up_steps:
            return decayed
        return decayed * (self.warm_up_start + (1 - self.warm_up_start) * step / self.warm_up_steps)


def make_optimizer(learning: nn.Module, backbone: nn.Module, config: OptimizerConfig) -> torch.optim.AdamW:
    """AdamW over two groups: all that learns but the backbone, and the backbone."""
    known = {id(parameter) for parameter in backbone.parameters()}
    others = [parameter for parameter in learning.parameters() if id(parameter) not in known]
    groups = [{"params": others, "share": 1.0}, {"params": list(backbone.parameters()), "share": config.backbone_share}]
    return torch.optim.AdamW(groups, lr=config.learning_rate, weight_decay=config.weight_decay)


def set_rate(optimizer: torch.optim.AdamW, rate: float) -> None:
    """The learning rate of the next step; each group takes its share of it."""
    for group in optimizer.param_groups:
        group["lr"] = rate * group["share"]


def clip_gradients(model: nn.Module, max_norm: float) -> float:
    """Shortens the gradient where it is longer than max_norm; returns how long it was."""
    return float(nn.utils.clip_grad_norm_(model.parameters(), max_norm))
