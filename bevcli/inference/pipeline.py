"""Around the model: other threads read and write frames, images go up, results come back, stages are timed.

While the model computes a frame, threads prepare the next ones and write those before. Results come back from a GPU
with one wait, which may come after the next frame was launched, and are checked.
"""

import re
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import fields, replace
from itertools import islice, pairwise
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from bevcli.errors import result_within
from bevcli.model.step import ModelOutputs, PreparedFrame
from bevcli.model.upload import exchanged, packed, tensors_in, unpacked, upload

S = TypeVar("S")
T = TypeVar("T")
READING_TIMEOUT_S = 1800.0  # of all images of a frame, or of a training step
WRITING_TIMEOUT_S = 120.0  # of one frame
QUEUE = 4  # frames that wait to be written; each of them keeps its images and its BEV map in memory


def read_ahead(
    work: Callable[[T], S],
    items: Iterable[Any],
    depth: int = 2,
    threads: int = 1,
    load: Callable[[Any], T] | None = None,
) -> Generator[S]:
    """Yields work(item) for every item, in order, computed in background threads up to `depth` items ahead.

    An exception in `work` or `load` is raised when its item is due. If the caller stops early, the items that have not
    begun are cancelled. Raises WaitError if an item is not there READING_TIMEOUT_S after it is due.

    load: makes what `work` takes of an item, in one more thread, in order. None: `work` takes the items.
    """
    what, source = "reading and preparing a frame", iter(items)
    pool = ThreadPoolExecutor(threads, thread_name_prefix="read-ahead")
    loader = None if load is None else ThreadPoolExecutor(1, thread_name_prefix="load-ahead")

    def begun(item: Any) -> Future[S]:
        if loader is None or load is None:
            return pool.submit(work, item)
        loaded = loader.submit(load, item)
        return pool.submit(lambda: work(result_within(loaded, READING_TIMEOUT_S, what)))

    pending = deque(map(begun, islice(source, depth)))
    try:
        while pending:
            result = result_within(pending.popleft(), READING_TIMEOUT_S, what)
            pending.extend(map(begun, islice(source, 1)))
            yield result
    finally:
        for threaded in (pool, loader):
            if threaded is not None:
                threaded.shutdown(wait=False, cancel_futures=True)


def write_behind(items: Iterable[T], write: Callable[[T], S], depth: int = QUEUE) -> Generator[S]:
    """Yields write(item) for every item, in order, computed in a background thread while the next items are made.

    After an error in `items`, or where the caller stops early, all items that were made are still written. Nothing is
    written after an error in `write`. Raises WaitError if an item takes more than WRITING_TIMEOUT_S.

    depth: items that may wait, beside the one that is written.
    """
    pool = ThreadPoolExecutor(1, thread_name_prefix="write-behind")
    pending = deque[Future[S]]()

    def write_after(before: Future[S] | None, item: T) -> S:
        if before is not None:
            before.result()  # raises its error
        return write(item)

    def written(kept: int) -> Iterator[S]:
        while pending and (len(pending) > kept or pending[0].done()):
            yield result_within(pending.popleft(), WRITING_TIMEOUT_S, "writing a frame")

    last: Future[S] | None = None
    try:
        for item in items:
            last = pool.submit(write_after, last, item)
            pending.append(last)
            yield from written(1 + depth)
        yield from written(0)
    except Exception:
        yield from written(0)
        raise
    finally:
        for _ in written(0):
            pass
        pool.shutdown(wait=False)


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


def read_back(outputs: ModelOutputs, images: Tensor) -> Callable[[], tuple[ModelOutputs, bool]]:
    """A function that waits for the last layers' outputs on the CPU, and tells whether all numbers are finite.

    Checked are the BEV map, the class logits and the box codes. There is one copy from a CUDA GPU: it is launched now,
    and what is launched later is not waited for. What `ModelOutputs.stay_on_device` names stays there. The input images
    must be finite too: the ReLU of oneDNN, and of cuDNN, turns NaN into zero, so that it may not reach the outputs.
    Weights are checked when they are read and when they are prepared. Not seen are numbers inside of the backbone that
    grow beyond the range of their type and that ReLU then turns into zeros.
    """
    last = outputs.last_layers()
    checked = [last.bev, last.class_logits, last.box_codes, upload(images, last.bev.device)]
    sums = torch.stack([tensor.sum(dtype=torch.float32) for tensor in checked])  # NaN and infinity stay in a sum
    moved = {item.name: getattr(last, item.name) for item in fields(last) if item.name not in last.stay_on_device}
    tensors = [sums, *(tensor for _, tensor in tensors_in(list(moved.values())))]
    copied = _copies(tensors)

    def read() -> tuple[ModelOutputs, bool]:
        sums, *copies = copied()
        source = iter(copies)
        on_cpu = replace(last, **{name: exchanged(value, source) for name, value in moved.items()})
        return on_cpu, bool(torch.isfinite(sums).all())

    return read


def _copies(tensors: list[Tensor]) -> Callable[[], list[Tensor]]:
    """A function that waits for copies of the tensors on the CPU. From a CUDA GPU there is one, launched now."""
    device = tensors[0].device
    if device.type != "cuda":
        return lambda: [tensor.cpu() for tensor in tensors]
    memory = packed(tensors)
    copy = pinned_place(memory).copy_(memory, non_blocking=True)
    is_there = torch.cuda.Event()
    is_there.record(torch.cuda.current_stream(device))

    def awaited() -> list[Tensor]:
        is_there.synchronize()
        return unpacked(copy, tensors)

    return awaited


def pinned_place(tensor: Tensor) -> Tensor:
    """Memory for a copy of a tensor, to which a GPU writes by itself. Needs a CUDA GPU."""
    return torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)


def origin(model: nn.Module, step: Callable[[], object]) -> str:
    """The origin of NaN or infinity: an input, or the first module whose output has any.

    model: the model that the step is made with. step: makes the step once more; every module is checked meanwhile.
    """
    origins: list[str] = []

    def check(value: object, module: str = "") -> None:
        tensors = [(name, tensor) for name, tensor in tensors_in(value, "history") if tensor.is_floating_point()]
        bad = [name for name, tensor in tensors if not torch.isfinite(tensor).all()]
        if bad and not origins:
            origins.append(module or f"input {bad[0]}")

    with ExitStack() as hooks:
        hooks.enter_context(model.register_forward_pre_hook(lambda module, arguments: check(arguments)))
        for name, module in model.named_modules():
            if name:
                hook = module.register_forward_hook(lambda *call, name=name: check(call[2], describe(name)))
                hooks.enter_context(hook)
        step()
    return origins[0] if origins else "the whole model"


def describe(name: str) -> str:
    """A module's name with the part of the paper's figure: "encoder layer 3 (encoder.layers.3.norms.0)"."""
    layer = re.match(r"(encoder|decoder)\.layers\.(\d+)", name)
    label = f"{layer[1]} layer {layer[2]}" if layer else name.split(".")[0].replace("_", " ")
    return label if label == name else f"{label} ({name})"


class StageClock(ExitStack):
    """Seconds of each stage of a step. The model has hooks inside the `with` block only:

        with clock:
            outputs = model(inputs)
            marks = clock.marks
        results = outputs.cpu()
        clock.waited(marks)
        clock.mark("decoding")
        clock.read()

    The next step may begin before `waited`.

    Time is attributed by marks: the time since the last mark belongs to the stage of the new mark. On a GPU, marks are
    events in its queue, until the CPU has waited for it. On "mps", every mark waits for it.

    Attributes:
        marks: of a step so far: stages, with seconds or events of a GPU's queue.
    """

    def __init__(
        self, model: nn.Module, device: torch.device, stages: Mapping[str, str], starts: Mapping[str, str] | None = None
    ) -> None:
        """A clock that is not running.

        Args:
            model: modules that it lacks are left out.
            device: where the model runs.
            stages: module name -> stage that is marked when the module ends.
            starts: module name -> stage that is marked before the module begins.
        """
        super().__init__()
        self._device = device
        self.marks: list[tuple[str, Any]] = []
        self._has_waited = False
        modules = dict(model.named_modules())
        ends = [(modules[name].register_forward_hook, stage) for name, stage in stages.items() if name in modules]
        begins = [(modules[name].register_forward_pre_hook, stage) for name, stage in (starts or {}).items()]
        self._marked: list[tuple[Callable[..., Any], str]] = [*ends, *begins]

    def __enter__(self) -> "StageClock":
        """A new step begins now."""
        for register, stage in self._marked:
            self.enter_context(register(lambda *_, stage=stage: self.mark(stage)))
        self.marks, self._has_waited = [], False
        self.mark("")
        return self

    def mark(self, stage: str) -> None:
        """The time since the last mark belongs to this stage."""
        now: Any = time.perf_counter()
        if self._device.type == "cuda" and not self._has_waited:
            now = torch.cuda.Event(enable_timing=True)
            now.record(torch.cuda.current_stream(self._device))
        elif self._device.type == "mps" and not self._has_waited:
            torch.mps.synchronize()  # its queue has no events that could be read later
            now = time.perf_counter()
        self.marks.append((stage, now))

    def waited(self, marks: list[tuple[str, Any]]) -> None:
        """The CPU has waited for the step that has these marks, and only the CPU computes in the rest of it."""
        self.marks, self._has_waited = marks, True
        self.marks.append(("", time.perf_counter()))

    def read(self) -> Mapping[str, float]:
        """Stage -> seconds, of the step. To call after `waited`, so that a GPU has passed its events."""
        seconds: dict[str, float] = {}
        for (_, before), (stage, now) in pairwise(self.marks):
            if stage:
                took = now - before if isinstance(now, float) else before.elapsed_time(now) / 1000
                seconds[stage] = seconds.get(stage, 0.0) + took
        return seconds
