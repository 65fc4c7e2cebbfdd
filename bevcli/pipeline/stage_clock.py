"""StageClock: the time of each stage of a step, measured by forward hooks on the model."""

from __future__ import annotations

import time
from collections.abc import Mapping
from types import TracebackType

import torch
from torch import nn
from torch.utils.hooks import RemovableHandle

# Module name -> the stage that ends with this module.
STAGES = {
    "backbone": "backbone",
    "neck": "neck",
    "encoder": "encoder",
    "fusion": "fusion",
    "decoder": "decoder",
    "query_interaction": "tracks",
    "map_head": "map_head",
    "segmentation_head": "segmentation_head",
}


class StageClock:
    """Seconds of each stage of one step. The model has hooks inside the `with` block only:

        with clock:
            model(inputs)
            clock.mark("decoding")
        clock.read()

    Time is attributed by marks: the time since the last mark belongs to the stage of the new mark. On a GPU, marks are
    events in its queue, and only `read` waits for the GPU. On "mps", every mark waits for it.
    """

    def __init__(
        self,
        model: nn.Module,
        device: torch.device,
        stages: Mapping[str, str] = STAGES,
        starts: Mapping[str, str] | None = None,
    ) -> None:
        """A clock that is not running.

        Args:
            model: modules that it lacks are left out.
            device: where the model runs.
            stages: module name -> stage that is marked when the module ends.
            starts: module name -> stage that is marked before the module begins.
        """
        self._device = device
        self._marks: list[tuple[str, float | torch.cuda.Event]] = []
        self._hooks: list[RemovableHandle] = []
        modules = dict(model.named_modules())
        self._ends = [(modules[name], stage) for name, stage in stages.items() if name in modules]
        self._starts = [(modules[name], stage) for name, stage in (starts or {}).items()]

    def __enter__(self) -> StageClock:
        """A new step begins now."""
        for module, stage in self._ends:
            self._hooks.append(module.register_forward_hook(lambda *_, stage=stage: self.mark(stage)))
        for module, stage in self._starts:
            self._hooks.append(module.register_forward_pre_hook(lambda *_, stage=stage: self.mark(stage)))
        self._marks = []
        self.mark("")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for hook in self._hooks:
            hook.remove()
        self._hooks = []

    def mark(self, stage: str) -> None:
        """The time since the last mark belongs to this stage."""
        self._marks.append((stage, self._now()))

    def read(self) -> Mapping[str, float]:
        """Stage -> seconds, of the last step."""
        if self._device.type == "cuda":
            torch.cuda.current_stream(self._device).synchronize()
        seconds: dict[str, float] = {}
        for (_, before), (stage, now) in zip(self._marks, self._marks[1:], strict=False):
            seconds[stage] = seconds.get(stage, 0.0) + _between(before, now)
        return seconds

    def _now(self) -> float | torch.cuda.Event:
        if self._device.type == "mps":
            torch.mps.synchronize()  # its queue has no events that could be read later
        if self._device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self._device))
        return event


def _between(before: float | torch.cuda.Event, now: float | torch.cuda.Event) -> float:
    if isinstance(before, float) and isinstance(now, float):
        return now - before
    assert not isinstance(before, float)
    assert not isinstance(now, float)
    return before.elapsed_time(now) / 1000
