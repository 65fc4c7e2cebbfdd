"""A GPU that is not there: tensors that claim to be on it, hold their numbers on the CPU, and record every wait.

    with SimulatedDevice("cuda:1") as device:
        result = model.to(device.device)(x.to(device.device))
    device.waits

An operator that would fail on the device fails here too: one whose tensors are on two devices, and on "mps" any that
uses float64. Kernels of other libraries see no numbers: replace them by the plain operation.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from functools import partial
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_flatten, tree_map

from bevcli.model.deformable_attention import GridSampling, sampling_locations
from bevcli.model.deformable_convolution import predicted_deformable_convolution

CPU = torch.device("cpu")
# Functions that read numbers back, to answer with a Python value or to find out a shape.
READING = {
    torch.Tensor.item, torch.Tensor.tolist, torch.Tensor.cpu, torch.Tensor.__bool__, torch.Tensor.__int__,
    torch.Tensor.__float__, torch.Tensor.__complex__, torch.Tensor.__index__, torch.Tensor.__contains__,
    torch.Tensor.__format__, torch.Tensor.__repr__, torch.Tensor.nonzero, torch.nonzero, torch.equal,
    torch.Tensor.equal, torch.masked_select, torch.Tensor.masked_select, torch.unique, torch.Tensor.unique,
    torch.unique_consecutive, torch.allclose, torch.isin, torch.argwhere, torch.bincount, torch.is_nonzero,
    torch.linalg.solve, torch.linalg.inv, torch.inverse,
}  # fmt: skip
REPEATING = {torch.repeat_interleave, torch.Tensor.repeat_interleave}
MAKING = {torch.tensor, torch.as_tensor, torch.Tensor.new_tensor}  # from Python numbers
INDEXING = {torch.Tensor.__getitem__, torch.Tensor.__setitem__}


class OnDevice(torch.Tensor):
    """A tensor that claims to be on a simulated device.

    Attributes:
        held: its numbers, a plain tensor of the same memory.
        home: the device.
    """

    held: Tensor
    home: SimulatedDevice

    def record_stream(self, stream: Any) -> None:
        """Memory is never given away too early."""
        assert isinstance(stream, Stream)


class SimulatedDevice(TorchFunctionMode):
    """Runs what is asked for on its device on the CPU.

    Attributes:
        device: what its tensors claim.
        waits: each operation for which the CPU would wait for the device, in order.
        copies: to pinned memory, which hold no numbers before the CPU has waited for them.
        tape: the operations since a capture began, with their arguments and results; None outside of one.
    """

    def __init__(self, name: str) -> None:
        super().__init__()
        self.device = torch.device(name)
        self.waits: list[str] = []
        self.copies: list[Callable[[], object]] = []
        self.tape: list[tuple[Any, Any, Any, Any]] | None = None

    def wait(self, name: str) -> None:
        """The CPU waits for the device, which a capture does not allow."""
        if self.tape is not None:
            raise RuntimeError(f"{name}: the CPU waits for {self.device} in a capture")
        self.waits.append(name)

    def record(self, function: Any, args: Any, kwargs: Any, found: Any) -> None:
        """Keeps an operation for the replay, in a capture."""
        if self.tape is not None:
            self.tape.append((function, args, kwargs, found))

    def tensor(self, held: Tensor) -> Tensor:
        """A tensor of these numbers on the device."""
        if held.dtype == torch.float64 and self.device.type == "mps":
            raise TypeError("mps has no float64")
        made = held.as_subclass(OnDevice)
        made.held, made.home = held, self
        return made

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if function is torch.Tensor.to and not any(isinstance(x, Tensor) for x in args[1:]):
            return self._to(*args, **kwargs)
        if function is torch.Tensor.__deepcopy__:
            return self._copied(*args)
        tensors = [leaf for leaf in tree_flatten((args, kwargs))[0] if isinstance(leaf, Tensor)]
        ours = {id(x.held): x for x in tensors if isinstance(x, OnDevice)}
        device = None if kwargs.get("device") is None else torch.device(kwargs["device"])
        comes = device is not None and device.type == self.device.type
        if not ours and not comes:
            return function(*args, **kwargs)
        if function is torch._has_compatible_shallow_copy_type:
            return False  # `Module.to` makes new parameters
        if function == torch.Tensor.device.__get__:
            return self.device
        self._check(function, tensors, args, kwargs)
        if function is torch.Tensor.copy_ and is_pinned(args[0]):
            held = args[1].held.clone()
            self.copies.append(lambda: args[0].copy_(held))
            return args[0].fill_(0)
        if comes:
            assert device is not None
            self.check(device)
            if function in MAKING:
                self.wait(f"{function.__name__}(…, device=…)")
            kwargs["device"] = CPU
        args, kwargs = tree_map(_held, args), tree_map(_held, kwargs)
        found = function(*args, **kwargs)
        self.record(function, args, kwargs, found)
        if function is torch.Tensor.cpu:
            return found.clone()

        def on_device(value: Any) -> Any:
            if id(value) in ours:
                return ours[id(value)]  # was changed in place
            if any(value is tensor for tensor in tensors):
                return value  # of the CPU, was changed in place
            return self.tensor(value) if isinstance(value, Tensor) else value

        return tree_map(on_device, found)

    def check(self, device: torch.device) -> None:
        """PyTorch takes a device without a number for the current one, the first: that is the wrong one for cuda:1."""
        if device != self.device:
            raise RuntimeError(f"a tensor for {device}, but the model is on {self.device}")

    def _check(self, function: Any, tensors: list[Tensor], args: Any, kwargs: Any) -> None:
        """Raises an error where the device would; notes where the CPU would wait."""
        name = getattr(function, "__name__", str(function))
        if function is torch.Tensor.numpy:
            raise TypeError(f"a tensor on {self.device} cannot become an array")
        if function is torch.Tensor.copy_:
            on_cpu = [x for x in args[:2] if isinstance(x, Tensor) and not isinstance(x, OnDevice)]
            if on_cpu and not (kwargs.get("non_blocking") and is_pinned(on_cpu[0])):
                self.wait(name)
            return
        if function in INDEXING:
            parts = args[1] if isinstance(args[1], tuple) else (args[1],)
            if any(isinstance(x, list) or (isinstance(x, Tensor) and not isinstance(x, OnDevice)) for x in parts):
                self.wait("index of the CPU")
            if any(isinstance(x, Tensor) and x.dtype == torch.bool for x in parts):
                self.wait("index of a mask")
            ends = [end for x in parts if isinstance(x, slice) for end in (x.start, x.stop, x.step)]
            if any(isinstance(x, OnDevice) and not x.ndim and x.dtype != torch.bool for x in (*parts, *ends)):
                self.wait("index of one element")
        elif any(not isinstance(x, OnDevice) and (x.ndim or self.tape is not None) for x in tensors):
            raise RuntimeError(f"{name}: tensors on {self.device} and on the CPU")
        by_tensor = function in REPEATING and isinstance(args[1], Tensor) and kwargs.get("output_size") is None
        by_condition = function in (torch.where, torch.Tensor.where) and len(tensors) == len(args) == 1
        one_hot = function is torch.nn.functional.one_hot and len(args) == 1 and "num_classes" not in kwargs
        if function in READING or by_tensor or by_condition or one_hot:
            self.wait(name)

    def _copied(self, tensor: Tensor, copies: dict[int, Any]) -> Tensor:
        """A deep copy. copies: of other tensors, on any device."""
        if not isinstance(tensor, OnDevice):
            return tensor.__deepcopy__(copies)
        copy = self.tensor(tensor.held.__deepcopy__({}))
        copy._is_param = isinstance(tensor, torch.nn.Parameter)  # what makes it one
        return copies.setdefault(id(tensor), copy)

    def _to(self, tensor: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        kwargs.pop("copy", None)
        device, dtype, non_blocking, memory_format = torch._C._nn._parse_to(*args, **kwargs)
        held = _held(tensor)
        wanted = {"dtype": dtype or held.dtype, "memory_format": memory_format or torch.preserve_format}
        changed = held.to(**wanted)
        self.record(torch.Tensor.to, (held,), wanted, changed)
        there, comes = isinstance(tensor, OnDevice), device is not None and device.type == self.device.type
        if comes:
            self.check(device)
        if there and (device is None or comes):
            return tensor if changed is held else self.tensor(changed)
        if comes:
            if self.tape is not None or not (non_blocking and is_pinned(tensor)):
                self.wait("upload")
            return self.tensor(changed.detach().clone())
        if there and (self.tape is not None or not non_blocking):  # the latter copies to pinned memory
            self.wait("copy to the CPU")
        return changed


def _held(value: Any) -> Any:
    return value.held if isinstance(value, OnDevice) else value


def pinned(tensor: Tensor) -> Tensor:
    """A copy in memory that counts as pinned."""
    copy = tensor.clone()
    copy.is_pinned_here = True  # type: ignore[attr-defined]
    return copy


def is_pinned(tensor: Tensor) -> bool:
    return getattr(tensor, "is_pinned_here", False)


class Stream:
    """A stream of the device, whose work is done at once."""

    def __init__(self, device: SimulatedDevice) -> None:
        self.device = device

    def synchronize(self) -> None:
        self.device.wait("synchronize")
        arrive(self.device.copies)

    def wait_stream(self, other: Stream) -> None:
        assert other.device is self.device


class Graph:
    """A CUDA graph: the operations of a capture. A replay runs no Python of the model."""

    def __init__(self) -> None:
        self.tape: list[tuple[Any, Any, Any, Any]] = []

    def replay(self) -> None:
        for function, args, kwargs, found in self.tape:
            again = function(*args, **kwargs)
            for old, new in zip(tree_flatten(found)[0], tree_flatten(again)[0], strict=True):
                if isinstance(old, Tensor) and old.data_ptr() != new.data_ptr():
                    old.copy_(new)


def arrive(copies: list[Callable[[], object]]) -> None:
    """The copies have their numbers."""
    for copy in copies:
        copy()
    copies.clear()


class Event:
    """An event that takes no time. It comes after the copies that were begun before it."""

    def __init__(self, device: SimulatedDevice, *, enable_timing: bool = False) -> None:
        self.device, self.enable_timing = device, enable_timing
        self.copies: list[Callable[[], object]] = []

    def record(self, stream: Stream | None = None) -> None:
        assert stream is None or isinstance(stream, Stream)
        if not self.enable_timing:
            self.copies, self.device.copies = self.device.copies, []

    def synchronize(self) -> None:
        self.device.wait("event")
        arrive(self.copies)

    def elapsed_time(self, later: Event) -> float:
        assert self.enable_timing
        assert later.enable_timing
        return 0.0


class Kernel:
    """A Triton kernel whose launch calls a plain function with the same arguments."""

    def __init__(self, device: SimulatedDevice, plain: Callable[..., None]) -> None:
        self.device, self.plain = device, plain

    def __getitem__(self, _grid: tuple[int, ...]) -> Callable[..., None]:
        return self.launch

    def launch(self, *args: Any, **constants: Any) -> None:
        self.plain(*args, **constants)
        self.device.record(self.plain, args, constants, None)


def hits_plainly(  # type: ignore[no-untyped-def]
    values, shapes, reference_points, offsets, logits, query, prediction, ends, out, hits, maps, cells, **constants
):
    """The numbers of the kernel `_sample_hits`, from the plain module."""
    read = (values, reference_points, offsets, logits, query, prediction)
    assert all(isinstance(each, OnDevice) and each.is_contiguous() for each in (*read, shapes, ends, out))
    assert values.shape[:2] == (maps, cells)
    assert len(query) == len(prediction) == hits
    sizes = tuple(map(tuple, shapes.held.tolist()))
    found = sample_hits_plainly(*(each.held for each in read), sizes, torch.diff(ends.held, prepend=torch.zeros(1)))
    out.held.copy_(found.view(out.shape))


def sample_hits_plainly(values, reference_points, offsets, logits, query, prediction, level_shapes, counts):  # type: ignore[no-untyped-def]
    """The weighted sums of hits by tables of locations and weights, see `compiled.sample_hits`."""
    offsets, logits = (each.transpose(1, 2)[query, prediction] for each in (offsets, logits))  # (M, heads, L, P, …)
    weights = logits.flatten(-2).softmax(-1).view_as(logits)
    points = reference_points.repeat(1, logits.shape[-1] // reference_points.shape[1], 1)
    locations = sampling_locations(points[:, None, None], offsets, GridSampling().level_sizes(level_shapes, CPU))
    return GridSampling()(values, level_shapes, locations, weights, [int(count) for count in counts])


def pool(values, bias, out, elements, *sizes, **constants):  # type: ignore[no-untyped-def]
    """The numbers of the kernel of this name, from PyTorch's own operations."""
    assert elements == out.held[0].numel()
    assert sizes == (*values.held.shape[2:], *out.held.shape[2:])
    out.held.copy_((F.max_pool2d(values.held, 3, 2, 1) + bias.held[:, None, None]).relu())


def convolution_relu(x, weight, bias, *rest):  # type: ignore[no-untyped-def]
    """`torch.cudnn_convolution_relu` from other operations."""
    return F.conv2d(x, weight, bias, *rest).relu()


def convolution_add_relu(x, weight, shortcut, alpha, bias, *rest):  # type: ignore[no-untyped-def]
    """`torch.cudnn_convolution_add_relu` from other operations."""
    return (F.conv2d(x, weight, bias, *rest) + alpha * shortcut).relu()


def in_turn(work: Any, items: Any, *_options: int, load: Callable[..., Any] = lambda item: item) -> Iterator[Any]:
    """As `read_ahead`, without threads: a mode of PyTorch's functions is one thread's."""
    return (work(load(item)) for item in items)


def provide_triton(monkeypatch: Any) -> None:
    """Puts the parts of Triton that surround a kernel in the place of a Triton that is not installed."""
    if find_spec("triton") is not None:
        return
    triton, language = ModuleType("triton"), ModuleType("triton.language")
    triton.__spec__ = ModuleSpec("triton", loader=None)
    parts = {
        "language": language,
        "jit": lambda kernel: kernel,
        "cdiv": lambda count, size: -(-count // size),
        "next_power_of_2": lambda number: 1 << (number - 1).bit_length(),
    }
    vars(triton).update(parts)
    language.constexpr = object
    monkeypatch.setitem(sys.modules, "triton", triton)
    monkeypatch.setitem(sys.modules, "triton.language", language)


@contextlib.contextmanager
def simulated(name: str, monkeypatch: Any, sample: Callable[..., None]) -> Iterator[SimulatedDevice]:
    """A simulated device. What only a real one has is replaced: pinned memory, events, streams, CUDA graphs, the Triton
    kernel.

    sample: takes the place of the launch of the Triton kernel, see `sample_plainly`.
    """
    device = SimulatedDevice(name)
    monkeypatch.setattr("bevcli.model.upload.pinned", pinned)
    monkeypatch.setattr("bevcli.inference.pipeline.pinned_place", lambda x: pinned(torch.empty(x.shape, dtype=x.dtype)))
    monkeypatch.setattr("bevcli.inference.runner.read_ahead", in_turn)
    monkeypatch.setattr("bevcli.runs.run_into_folder.write_behind", lambda items, write: in_turn(write, items))
    monkeypatch.setattr(torch.mps, "synchronize", lambda: None)
    if device.device.type == "cuda":
        _provide_cuda(device, monkeypatch)
        provide_triton(monkeypatch)
        from bevcli.model.kernels import triton_attention, triton_convolution

        monkeypatch.setattr(triton_convolution, "deformable_convolution", predicted_deformable_convolution)
        monkeypatch.setattr(torch, "cudnn_convolution_relu", convolution_relu)
        monkeypatch.setattr(torch, "cudnn_convolution_add_relu", convolution_add_relu)
        for module, name, plain in (
            (triton_attention, "_sample", sample),
            (triton_attention, "_sample_hits", hits_plainly),
            (triton_convolution, "_pool", pool),
        ):
            monkeypatch.setattr(module, name, Kernel(device, plain))
    with device:
        yield device


def _provide_cuda(device: SimulatedDevice, monkeypatch: Any) -> None:
    stream = Stream(device)

    @contextlib.contextmanager
    def capture(graph: Graph, *, pool: str, stream: Stream, capture_error_mode: str) -> Iterator[None]:
        assert (pool, stream.device, capture_error_mode) == ("pool", device, "thread_local")
        device.tape = graph.tape
        try:
            yield
        finally:
            device.tape = None

    parts = {
        "device": lambda which: contextlib.nullcontext(device.check(which)),
        "stream": lambda which: contextlib.nullcontext(),
        "Stream": lambda which: Stream(device),
        "current_stream": lambda which: stream,
        "synchronize": lambda which=None: device.wait("synchronize"),
        "Event": partial(Event, device),
        "CUDAGraph": Graph,
        "graph_pool_handle": lambda: "pool",
        "graph": capture,
    }
    for part, value in parts.items():
        monkeypatch.setattr(torch.cuda, part, value)


def provide_training(device: SimulatedDevice, monkeypatch: Any) -> None:
    """Replaces what else a training asks of a GPU: autocast, random numbers, the kernel with gradients."""
    from bevcli.model.kernels import triton_attention

    monkeypatch.setattr(triton_attention, "TritonSampling", GridSampling)
    grouped = torch.nn.utils.clip_grad._group_tensors_by_device_and_dtype

    def grouped_there(lists: Any, **options: Any) -> Any:
        return {(device.device, dtype): found for (_, dtype), found in grouped(lists, **options).items()}

    monkeypatch.setattr(torch.nn.utils.clip_grad, "_group_tensors_by_device_and_dtype", grouped_there)
    autocast, generator = torch.autocast, torch.Generator
    monkeypatch.setattr(torch, "autocast", lambda kind, *args, **options: autocast("cpu", *args, **options))
    monkeypatch.setattr(torch, "Generator", lambda which=CPU: generator())
    monkeypatch.setattr(torch.cuda, "get_rng_state", lambda which: torch.get_rng_state())
    monkeypatch.setattr(torch.cuda, "set_rng_state", lambda state, which: None)
