"""StageClock: how long each stage of a step takes, seen from outside the model by forward hooks."""

from __future__ import annotations

import time
from collections.abc import Mapping

import torch
from torch import nn

STAGES = ("backbone", "neck", "encoder", "decoder", "segmentation_head")


class StageClock:
    """Seconds per stage of one step. On a GPU the stages are told apart by waiting for it, which costs little."""

    def __init__(self, model: nn.Module, device: torch.device) -> None:
        self._device = device
        self._last = 0.0
        self._seconds: dict[str, float] = {}
        for name, module in model.named_children():
            if name in STAGES:
                module.register_forward_hook(lambda *_, name=name: self.mark(name))

    def start(self) -> None:
        """A new step begins now."""
        self._seconds = {}
        self._last = self._now()

    def mark(self, stage: str) -> None:
        """What passed since the last mark belongs to this stage."""
        now = self._now()
        self._seconds[stage] = self._seconds.get(stage, 0.0) + now - self._last
        self._last = now

    def read(self) -> Mapping[str, float]:
        """Stage -> seconds, of the step so far."""
        return dict(self._seconds)

    def _now(self) -> float:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return time.perf_counter()
