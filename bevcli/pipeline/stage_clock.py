"""StageClock: how long each stage of a step takes, seen from outside the model by hooks."""

from __future__ import annotations

import time
from collections.abc import Mapping

import torch
from torch import nn

# Stage of what has been computed when a module is done, by the module's name.
STAGES = {
    "backbone": "backbone",
    "neck": "neck",
    "encoder": "encoder",
    "decoder": "decoder",
    "segmentation_head": "segmentation_head",
}


class StageClock:
    """Seconds per stage of one step.

    stages: module name -> stage; what passed since the last mark belongs to it once the module is done. starts:
    the same for the moment before a module begins. On a GPU the marks are events in its queue: nothing waits for
    it before `read`.
    """

    def __init__(
        self,
        model: nn.Module,
        device: torch.device,
        stages: Mapping[str, str] = STAGES,
        starts: Mapping[str, str] | None = None,
    ) -> None:
        self._on_gpu = device.type == "cuda"
        self._marks: list[tuple[str, float | torch.cuda.Event]] = []
        modules = dict(model.named_modules())
        for name in stages.keys() & modules.keys():
            modules[name].register_forward_hook(lambda *_, stage=stages[name]: self.mark(stage))
        for name, stage in (starts or {}).items():
            modules[name].register_forward_pre_hook(lambda *_, stage=stage: self.mark(stage))

    def start(self) -> None:
        """A new step begins now."""
        self._marks = []
        self.mark("")

    def mark(self, stage: str) -> None:
        """What passed since the last mark belongs to this stage."""
        self._marks.append((stage, self._now()))

    def read(self) -> Mapping[str, float]:
        """Stage -> seconds, of the step so far."""
        if self._on_gpu:
            torch.cuda.synchronize()
        seconds: dict[str, float] = {}
        for (_, before), (stage, now) in zip(self._marks, self._marks[1:], strict=False):
            seconds[stage] = seconds.get(stage, 0.0) + _between(before, now)
        return seconds

    def _now(self) -> float | torch.cuda.Event:
        if not self._on_gpu:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event


def _between(before: float | torch.cuda.Event, now: float | torch.cuda.Event) -> float:
    if isinstance(before, float) and isinstance(now, float):
        return now - before
    assert not isinstance(before, float)
    assert not isinstance(now, float)
    return before.elapsed_time(now) / 1000
