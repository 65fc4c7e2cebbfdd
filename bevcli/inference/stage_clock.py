"""StageClock: the time of each stage of a step, measured by forward hooks on the model."""

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from itertools import pairwise
from typing import Any

import torch
from torch import nn


class StageClock:
    """Seconds of each stage of one step. The model has hooks inside the `with` block only:

        with clock:
            outputs = model(inputs)
            results = outputs.cpu()
            clock.waited()
            clock.mark("decoding")
        clock.read()

    Time is attributed by marks: the time since the last mark belongs to the stage of the new mark. On a GPU, marks are
    events in its queue, until the CPU has waited for it. On "mps", every mark waits for it.
    """

    def __init__(
        self,
        model: nn.Module,
        device: torch.device,
        stages: Mapping[str, str],
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
        self._marks: list[tuple[str, Any]] = []  # with seconds, or events of a GPU's queue
        self._has_waited = False
        self._hooks = ExitStack()
        modules = dict(model.named_modules())
        ends = [(modules[name].register_forward_hook, stage) for name, stage in stages.items() if name in modules]
        begins = [(modules[name].register_forward_pre_hook, stage) for name, stage in (starts or {}).items()]
        self._marked: list[tuple[Callable[..., Any], str]] = [*ends, *begins]

    def __enter__(self) -> "StageClock":
        """A new step begins now."""
        for register, stage in self._marked:
            self._hooks.enter_context(register(lambda *_, stage=stage: self.mark(stage)))
        self._marks, self._has_waited = [], False
        self.mark("")
        return self

    def __exit__(self, *_error: object) -> None:
        self._hooks.close()

    def mark(self, stage: str) -> None:
        """The time since the last mark belongs to this stage."""
        self._marks.append((stage, time.perf_counter() if self._has_waited else self._now()))

    def waited(self) -> None:
        """The CPU has waited for the GPU, and only the CPU computes in the rest of the step."""
        self._has_waited = True
        self._marks.append(("", time.perf_counter()))

    def read(self) -> Mapping[str, float]:
        """Stage -> seconds, of the last step. To call after `waited`, so that a GPU has passed its events."""
        seconds: dict[str, float] = {}
        for (_, before), (stage, now) in pairwise(self._marks):
            if stage:
                took = now - before if isinstance(now, float) else before.elapsed_time(now) / 1000
                seconds[stage] = seconds.get(stage, 0.0) + took
        return seconds

    def _now(self) -> Any:
        if self._device.type == "mps":
            torch.mps.synchronize()  # its queue has no events that could be read later
        if self._device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self._device))
        return event
