"""Engines: ONNX Runtime and OpenVINO on the CPU, with one interface. Each runs an exported file."""

import contextlib
import importlib
import logging
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from torch import nn

from bevcli.errors import BevcliError, WeightsError
from bevcli.registry import entries, load

Arrays = Mapping[str, np.ndarray]

LARGEST_BYTES = 2**31  # protobuf's own limit, which every file of `bevcli export-onnx` keeps


def require(*names: str, extra: str = "onnx") -> None:
    """Raises BevcliError where one of these packages is not installed. extra: of bevcli, which installs them."""
    missing = [name for name in names if find_spec(name) is None]
    if missing:
        raise BevcliError(f"{', '.join(missing)}: not installed; run pip install 'bevcli[{extra}]'")


@contextlib.contextmanager
def errors_only(*names: str) -> Iterator[None]:
    """Inside, these loggers of other packages tell errors only; "" is the root of all loggers."""
    levels = {logger: logger.level for logger in map(logging.getLogger, names)}
    for logger in levels:
        logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


def import_openvino() -> Any:
    """The package openvino, without its telemetry.

    When it is imported for the first time, openvino sends a message to Google Analytics by the package
    openvino_telemetry. Without that package it takes a stub, which sends nothing.
    """
    hidden = "openvino_telemetry"
    before = sys.modules.get(hidden)
    sys.modules[hidden] = None  # type: ignore[assignment]  # import then raises ImportError
    try:
        return importlib.import_module("openvino")
    finally:
        if before is None:
            del sys.modules[hidden]
        else:
            sys.modules[hidden] = before


class Engine(nn.Module):
    """An exported file, loaded. A module without parameters, so that its time can be measured like any other part's.

    An engine is registered under `bevcli.engines`: a subclass, made from the file and a number of threads.

    Attributes:
        packages: that it needs.
        extra: of bevcli, which installs them.
        rank: of the engines that are installed, the lowest is taken where none is named and none was measured.
        deformable_convolution: as `OnnxOptions.deformable_convolution`, for files that are exported for it.
        metadata: of the file: text by name.
        input_shapes: name of each input -> its shape.
        outputs: names of the outputs.
    """

    packages: ClassVar[tuple[str, ...]] = ()
    extra: ClassVar[str] = "onnx"
    rank: ClassVar[int] = 2
    deformable_convolution: ClassVar[Literal["operator", "gridsample"]] = "operator"
    metadata: Mapping[str, str]
    input_shapes: Mapping[str, tuple[int, ...]]
    outputs: tuple[str, ...]

    def __init__(self, file: Path, threads: int) -> None:
        """Raises BevcliError where the program is not installed, WeightsError for a file that it cannot load."""
        super().__init__()
        self.require_packages()

    @classmethod
    def require_packages(cls) -> None:
        """Raises BevcliError where a package that it needs is not installed."""
        require(*cls.packages, extra=cls.extra)

    def forward(self, feed: Arrays) -> dict[str, np.ndarray]:
        """One step. feed: every input by name. Returns every output by name."""
        raise NotImplementedError


class OnnxRuntimeEngine(Engine):
    """ONNX Runtime on the CPU, in the precision of the file."""

    packages = ("onnxruntime",)
    rank = 1

    def __init__(self, file: Path, threads: int) -> None:
        super().__init__(file, threads)
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3  # errors only
        # Waiting threads sleep, as PyTorch's do here: spinning ones slow down the rest of the run.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            check_size(file)
            self.session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # ONNX Runtime has classes of its own for a missing and for a broken file
            raise _cannot_load(file, "ONNX Runtime", error) from error
        self.metadata = self.session.get_modelmeta().custom_metadata_map
        self.input_shapes = {value.name: tuple(value.shape) for value in self.session.get_inputs()}
        self.outputs = tuple(value.name for value in self.session.get_outputs())

    def forward(self, feed: Arrays) -> dict[str, np.ndarray]:
        return dict(zip(self.outputs, self.session.run(self.outputs, dict(feed)), strict=True))


class OpenVinoEngine(Engine):
    """OpenVINO on the CPU, in the precision of the file."""

    packages = ("openvino", "onnx")
    extra = "openvino"
    rank = 0  # the fastest one in INT8 on every processor that was measured
    deformable_convolution = "gridsample"  # it lacks DeformConv

    def __init__(self, file: Path, threads: int) -> None:
        super().__init__(file, threads)
        import onnx

        settings: dict[str, Any] = {
            # By default OpenVINO rounds everything to bfloat16 where the CPU has it, which moves boxes by decimetres.
            "INFERENCE_PRECISION_HINT": "f32",
            "INFERENCE_NUM_THREADS": threads,
            "NUM_STREAMS": 1,
            # A thread that is bound to a core waits for it while another process computes there.
            "ENABLE_CPU_PINNING": False,
        }
        try:
            check_size(file)
            # OpenVINO drops the metadata of a file.
            proto = onnx.load(str(file), load_external_data=False)
            self.model = _openvino_core().compile_model(str(file), "CPU", settings)
        except Exception as error:  # both have classes of their own
            raise _cannot_load(file, "OpenVINO", error) from error
        self.metadata = {entry.key: entry.value for entry in proto.metadata_props}
        self.input_shapes = {port.any_name: tuple(port.shape) for port in self.model.inputs}
        self.outputs = tuple(port.any_name for port in self.model.outputs)
        self.request = self.model.create_infer_request()

    def forward(self, feed: Arrays) -> dict[str, np.ndarray]:
        found = self.request.infer(dict(feed), share_inputs=True)
        return {name: found[name] for name in self.outputs}


def installed_engines() -> dict[str, type[Engine]]:
    """The engines whose packages are installed, the one with the lowest rank first."""
    found = {}
    for name in entries("bevcli.engines"):
        try:
            engine: type[Engine] = load("bevcli.engines", name)
            engine.require_packages()
        except BevcliError:  # not installed, or a broken package of somebody else
            continue
        found[name] = engine
    return dict(sorted(found.items(), key=lambda item: item[1].rank))


@cache
def _openvino_core() -> Any:
    """OpenVINO's one core of this process, which is never deleted.

    On a processor with AMX each core sets a stack for signals and, when it is deleted, restores the one before, which
    another core may have freed. The next Ctrl-C would then end the process with a segmentation fault (2026.4).
    """
    return import_openvino().Core()


def check_size(file: Path) -> None:
    """Raises OSError for a missing file, ValueError for one that is larger than an exported file can be."""
    size = file.stat().st_size
    if size > LARGEST_BYTES:
        raise ValueError(f"it has {size} bytes (expected at most {LARGEST_BYTES})")


def _cannot_load(file: Path, program: str, error: Exception) -> WeightsError:
    if isinstance(error, OSError) and error.strerror:
        return WeightsError(f"{file}: {error.strerror}")
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return WeightsError(f"{file}: {program} cannot load it: {lines[-1] if lines else type(error).__name__}")
