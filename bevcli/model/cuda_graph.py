"""The device part of a step as a CUDA graph: one launch by the CPU in the place of hundreds."""

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import nn

from bevcli.model import upload
from bevcli.model.upload import exchanged, tensors_in

KEPT_GRAPHS = 8  # of one function: for other numbers and sizes of images, with and without history
Function = Callable[..., Any]
_SETTING = threading.RLock()  # the precision of products is a setting of the process


class CudaGraph:
    """One captured call of a function, with input and output tensors of its own that every replay uses again."""

    def __init__(self, function: Function, arguments: tuple[Any, ...], device: torch.device, pool: Any) -> None:
        """Captures the call; tensors on the CPU are uploaded. pool: memory that all graphs of a function share, as
        never two of them run at once.

        Raises RuntimeError where an operation cannot be captured, such as a wait for the GPU.
        """
        self._sources = [tensor for _, tensor in tensors_in(arguments)]
        small = [tensor for tensor in self._sources if tensor.device.type == "cpu"]
        self._uploaded = upload.upload(upload.packed(small), device) if small else None
        of_cpu = iter([] if self._uploaded is None else upload.unpacked(self._uploaded, small))
        self._inputs = [next(of_cpu) if x.device.type == "cpu" else x.clone() for x in self._sources]
        own = exchanged(arguments, iter(self._inputs))
        with torch.cuda.device(device):
            stream = torch.cuda.Stream(device)
            stream.wait_stream(torch.cuda.current_stream(device))
            with torch.cuda.stream(stream):
                function(*own)  # libraries make their workspaces for this stream
            torch.cuda.current_stream(device).wait_stream(stream)
            self._graph = torch.cuda.CUDAGraph()
            # Other threads allocate and copy meanwhile: the one that uploads images, and those of other runs.
            with torch.cuda.graph(self._graph, pool=pool, stream=stream, capture_error_mode="thread_local"):
                self._outputs = function(*own)

    def replay(self, arguments: tuple[Any, ...]) -> Any:
        """The results for other arguments of the same shapes, in new memory."""
        small = []
        for index, (_, tensor) in enumerate(tensors_in(arguments)):
            if tensor.device.type == "cpu":
                small.append(tensor)
            elif tensor is not self._sources[index]:  # hits of a rig stay the same for many frames
                self._inputs[index].copy_(tensor, non_blocking=True)
                self._sources[index] = tensor
        if self._uploaded is not None:
            self._uploaded.copy_(upload.pinned(upload.packed(small)), non_blocking=True)
        self._graph.replay()
        return exchanged(self._outputs, (tensor.clone() for _, tensor in tensors_in(self._outputs)))


class Captured:
    """Takes the place of a method that is a pure function of tensors on a CUDA GPU.

    The first call with arguments of some shapes computes as ever, which compiles kernels and makes tables. The second
    one captures a CUDA graph, which is replayed from then on. Where submodules are observed by hooks, or a capture
    has failed, nothing is replayed.

    Attributes:
        graphs: by shapes of the arguments, None before the second call; the last used at the end.
        failure: of a capture, after which there are no graphs.
    """

    def __init__(self, function: Function, model: nn.Module, device: torch.device, *, rounds: bool) -> None:
        """function: a method of the model, which is complete. rounds: see `rounded_products`."""
        self._function, self._device, self._rounds = function, device, rounds
        parts = [module for module in model.modules() if module is not model]
        hooks = [hooks for part in parts for hooks in (part._forward_hooks, part._forward_pre_hooks)]
        self._no_hooks, self._own = [each for each in hooks if not each], [each for each in hooks if each]
        self._own_hooks = sum(map(len, self._own))
        self.graphs: OrderedDict[Any, CudaGraph | None] = OrderedDict()
        self._pool: Any = None
        self._lock = threading.Lock()  # runs in several threads share the inputs of a graph
        self.failure: BaseException | None = None

    def __call__(self, *arguments: Any) -> Any:
        """As the method itself. Arguments may be nested tuples and frozen dataclasses; tensors must not change."""
        with torch.inference_mode():
            if self.failure is None and not self._is_observed():
                with self._lock:
                    graph = self._graph_for(arguments)
                    if graph is not None:
                        return graph.replay(arguments)
            with rounded_products(self._rounds):
                return self._function(*arguments)

    def _graph_for(self, arguments: tuple[Any, ...]) -> CudaGraph | None:
        """The graph for arguments of these shapes; None where they come for the first time or cannot be captured."""
        key = exchanged(arguments, ((tuple(x.shape), x.dtype, x.device) for _, x in tensors_in(arguments)))
        if key not in self.graphs:
            self.graphs[key] = None
            if len(self.graphs) > KEPT_GRAPHS:
                self.graphs.popitem(last=False)
            return None
        self.graphs.move_to_end(key)
        if self.graphs[key] is None:
            self.graphs[key] = self._capture(arguments)
        return self.graphs[key]

    def _capture(self, arguments: tuple[Any, ...]) -> CudaGraph | None:
        try:
            if self._pool is None:
                self._pool = torch.cuda.graph_pool_handle()
            with rounded_products(self._rounds):
                return CudaGraph(self._function, arguments, self._device, self._pool)
        except Exception as error:  # whatever a driver, a library or a kernel raises: the model runs without a graph
            self.failure = error
            self.graphs.clear()
            reason = " ".join(str(error).split())[:200]
            logging.getLogger("bevcli").warning("no CUDA graph could be captured, steps take longer: %s", reason)
            return None

    def _is_observed(self) -> bool:
        return any(self._no_hooks) or sum(map(len, self._own)) != self._own_hooks


@contextmanager
def rounded_products(enabled: bool) -> Iterator[None]:
    """With `enabled`, products of float32 matrices on a CUDA GPU round their factors to TF32, of 10 bits, inside."""
    if not enabled:
        yield
        return
    setting = torch.backends.cuda.matmul
    name, value = ("fp32_precision", "tf32") if hasattr(setting, "fp32_precision") else ("allow_tf32", True)
    with _SETTING:
        before = getattr(setting, name)
        setattr(setting, name, value)
        try:
            yield
        finally:
            setattr(setting, name, before)
