"""A model's device: images go up meanwhile, results come back with one wait and are checked, stages are timed."""

import re
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import fields, replace
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from bevcli.model.step import ModelOutputs, PreparedFrame
from bevcli.model.upload import exchanged, packed, tensors_in, unpacked, upload


def image_uploader(device: torch.device) -> Callable[[PreparedFrame], PreparedFrame]:
    """A function that gives frames their images on a CUDA GPU, uploaded on a stream of its own.

    To call in the thread that runs the model. The thread that reads frames ahead calls the function: it waits for the
    copy, and the model does not.
    """
    stream, of_model = torch.cuda.Stream(device), torch.cuda.current_stream(device)

    def uploaded(prepared: PreparedFrame) -> PreparedFrame:
        with torch.cuda.stream(stream):
            images = upload(prepared.images, device)
        # The allocator must not give the memory away while the model's stream may still read it.
        images.record_stream(of_model)
        stream.synchronize()
        return replace(prepared, images=images)

    return uploaded


def read_back(outputs: ModelOutputs, images: Tensor) -> tuple[ModelOutputs, bool]:
    """The last layers' outputs on the CPU, and whether the BEV map, the class logits and the box codes are finite.

    There is one copy from a CUDA GPU. What `ModelOutputs.stay_on_device` names stays there. The input images
    must be finite too: the ReLU of oneDNN, and of cuDNN, turns NaN into zero, so that it may not reach the outputs.
    Weights are checked when they are read and when they are prepared. Not seen are numbers inside of the backbone that
    grow beyond the range of their type and that ReLU then turns into zeros.
    """
    last = outputs.last_layers()
    checked = [last.bev, last.class_logits, last.box_codes, upload(images, last.bev.device)]
    sums = torch.stack([tensor.sum(dtype=torch.float32) for tensor in checked])  # NaN and infinity stay in a sum
    moved = {part.name: getattr(last, part.name) for part in fields(last) if part.name not in last.stay_on_device}
    tensors = [sums, *(tensor for _, tensor in tensors_in(list(moved.values())))]
    if sums.device.type == "cuda":
        memory = packed(tensors)
        copy = pinned_place(memory).copy_(memory, non_blocking=True)
        torch.cuda.current_stream(sums.device).synchronize()
        sums, *copies = unpacked(copy, tensors)
    else:
        sums, *copies = (tensor.cpu() for tensor in tensors)
    source = iter(copies)
    on_cpu = replace(last, **{name: exchanged(value, source) for name, value in moved.items()})
    return on_cpu, bool(torch.isfinite(sums).all())


def pinned_place(tensor: Tensor) -> Tensor:
    """Memory for a copy of a tensor, to which a GPU writes by itself. Needs a CUDA GPU."""
    return torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)


def origin(model: nn.Module, step: Callable[[], object]) -> str:
    """The origin of NaN or infinity: an input, or the first module whose output has any.

    model: the model that the step is made with. step: makes the step once more; every module is checked meanwhile.
    """
    found: list[str] = []

    def check(value: object, place: str = "") -> None:
        tensors = [(name, tensor) for name, tensor in tensors_in(value, "history") if tensor.is_floating_point()]
        bad = [name for name, tensor in tensors if not torch.isfinite(tensor).all()]
        if bad and not found:
            found.append(place or f"input {bad[0]}")

    with ExitStack() as hooks:
        hooks.enter_context(model.register_forward_pre_hook(lambda module, arguments: check(arguments)))
        for name, module in model.named_modules():
            if name:
                hook = module.register_forward_hook(lambda *call, name=name: check(call[2], describe(name)))
                hooks.enter_context(hook)
        step()
    return found[0] if found else "the whole model"


def describe(name: str) -> str:
    """A module's name with the part of the paper's figure: "encoder layer 3 (encoder.layers.3.norms.0)"."""
    layer = re.match(r"(encoder|decoder)\.layers\.(\d+)", name)
    part = f"{layer[1]} layer {layer[2]}" if layer else name.split(".")[0].replace("_", " ")
    return part if part == name else f"{part} ({name})"


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
        now: Any = time.perf_counter()
        if self._device.type == "cuda" and not self._has_waited:
            now = torch.cuda.Event(enable_timing=True)
            now.record(torch.cuda.current_stream(self._device))
        elif self._device.type == "mps" and not self._has_waited:
            torch.mps.synchronize()  # its queue has no events that could be read later
            now = time.perf_counter()
        self._marks.append((stage, now))

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
