"""A clip through the model: the history comes without gradient, the frames that are learned from with it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn

from bevcli.model.bevformer import BEVFormer, BEVFormerInputs, BEVFormerOutputs


def forward_clip(
    model: BEVFormer, steps: Sequence[BEVFormerInputs], *, learn_all: bool = False, freeze_batch_norm: bool = False
) -> Iterator[BEVFormerOutputs]:
    """The outputs, in training mode, for the last of the steps; those before it only make its history.

    learn_all: for every step instead, one after another, so that the model may be updated in between.
    freeze_batch_norm: keep the running statistics, as fine-tuning of published weights does.
    """
    history: Tensor | None = None
    only_history = () if learn_all else steps[:-1]
    model.eval()
    with torch.no_grad():
        for inputs in only_history:
            history = model.bev_map(inputs, history)
    model.train()
    if freeze_batch_norm:
        for module in model.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()
    for inputs in steps[len(only_history) :]:
        outputs = model(inputs, history)
        history = outputs.bev.detach()
        yield outputs
