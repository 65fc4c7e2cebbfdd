"""A clip through the model as in the paper: history without gradient, the last frame with it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from bevcli.model.bevformer import BEVFormer, BEVFormerInputs, BEVFormerOutputs


def forward_clip(
    model: BEVFormer, steps: Sequence[BEVFormerInputs], *, freeze_batch_norm: bool = False
) -> BEVFormerOutputs:
    """The outputs for the last of the steps, in training mode; those before it only make its history.

    freeze_batch_norm: keep the running statistics, as fine-tuning of published weights does.
    """
    history: Tensor | None = None
    model.eval()
    with torch.no_grad():
        for inputs in steps[:-1]:
            history = model.bev_map(inputs, history)
    model.train()
    if freeze_batch_norm:
        for module in model.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()
    return model(steps[-1], history)
