"""Engines: ONNX Runtime and OpenVINO on the CPU, with one interface, which brings all that bevcli does with one."""

import importlib
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch

from bevcli.errors import BevcliError, WeightsError
from bevcli.frame import Sequence
from bevcli.geometry.cameras import CameraRig
from bevcli.inference.load import Model, tracker_of_table
from bevcli.inference.options import ModelOptions
from bevcli.model.config import ModelConfig
from bevcli.registry import load
from bevcli.workshop.engines.export_cache import exported_for_rig
from bevcli.workshop.engines.export_form import export_form
from bevcli.workshop.engines.export_onnx import EXPORTERS, QUANTIZERS, check_size, require
from bevcli.workshop.engines.exported import Arrays, ExportedModel, LoadedFile


class Engine(LoadedFile):
    """A program that runs exported files. An instance is a file, loaded.

    An engine is registered under `bevcli.engines`: a subclass, made from the file and a number of threads, that sets
    the attributes of `LoadedFile` and has its `forward`.

    Attributes:
        packages: that it needs.
        extra: of bevcli, which installs them.
        rank: of the engines that are installed, the lowest is taken for INT8 where none is named.
        deformable_convolution: as `OnnxOptions.deformable_convolution`, for files that are exported for it.
    """

    packages: ClassVar[tuple[str, ...]] = ()
    extra: ClassVar[str] = "onnx"
    rank: ClassVar[int] = 2
    deformable_convolution: ClassVar[Literal["operator", "gridsample"]] = "operator"

    def __init__(self, file: Path, threads: int) -> None:
        """Raises BevcliError where the program is not installed, WeightsError for a file that it cannot load."""
        super().__init__()
        self.require_packages()

    @classmethod
    def require_packages(cls) -> None:
        """Raises BevcliError where a package that it needs is not installed."""
        require(*cls.packages, extra=cls.extra)

    @classmethod
    def open(cls, file: Path, threads: int | None = None) -> ExportedModel:
        """An exported file in the place of a model. threads: that it uses; None takes PyTorch's number.

        Raises:
            BevcliError: the engine is not installed.
            WeightsError: the file is missing, cannot be loaded, or is not of `bevcli export-onnx`.
            ConfigError: the model in its metadata is wrong.
        """
        return ExportedModel(file, cls(file, torch.get_num_threads() if threads is None else threads))

    @classmethod
    def open_model(cls, name: str, options: ModelOptions) -> Model:
        """The model of an exported file, `options.model`. name: of the engine. Raises BevcliError, as `open` does."""
        file = Path(str(options.model))
        if options.weights is not None or options.untrained:
            option = "`untrained`" if options.untrained else f"`weights={options.weights}`"
            raise WeightsError(f"{file}: an exported file holds its weights: leave out {option}")
        if options.precision is not None:
            raise BevcliError(
                f"`precision={options.precision}`: {file} has a fixed precision: leave out the option "
                "(bevcli quantize writes files with INT8)"
            )
        if str(options.device) not in ("auto", "cpu"):
            raise BevcliError(f"`device={options.device}`: {file} runs on the CPU: leave out the option")
        network = cls.open(file)
        stated = network.metadata
        return Model(
            network,
            precision=stated.precision,
            weights=None if stated.untrained else file,
            bundled=stated.bundled,
            tracker=tracker_of_table(stated.contents, stated.config, str(file)),
            engine=name,
            file=file,
        )

    @classmethod
    def check_options(cls, name: str, options: ModelOptions, config: ModelConfig) -> None:
        """Raises BevcliError where the engine, `name`, is not installed or cannot run a model with these options."""
        if options.precision not in (None, "fp32", "int8"):
            raise BevcliError(f"`precision={options.precision}`: `engine={name}` computes in fp32 or int8")
        if str(options.device) not in ("auto", "cpu"):
            raise BevcliError(f"`device={options.device}`: `engine={name}` runs on the CPU: leave out the option")
        cls.require_packages()
        require(*EXPORTERS, *(QUANTIZERS if options.precision == "int8" else ()))
        export_form(config, len(config.cameras))

    @classmethod
    def export(cls, model: Model, rig: CameraRig, drive: Sequence | None, report: Callable[[str], None]) -> Model:
        """A model that is loaded for this engine, as an exported file for a rig, see `Model.in_engine`."""
        return exported_for_rig(model, rig, drive, report, cls.open, cls.deformable_convolution)


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
        outputs = self.request.infer(dict(feed), share_inputs=True)
        return {name: outputs[name] for name in self.outputs}


def load_exported(file: Path, engine: str, threads: int | None = None) -> ExportedModel:
    """An exported file in the place of a model, see `Engine.open`. engine: a name of `bevcli.engines`."""
    kind: type[Engine] = load("bevcli.engines", engine)
    return kind.open(file, threads)


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


@cache
def _openvino_core() -> Any:
    """OpenVINO's one core of this process, which is never deleted.

    On a processor with AMX each core sets a stack for signals and, when it is deleted, restores the one before, which
    another core may have freed. The next Ctrl-C would then end the process with a segmentation fault (2026.4).
    """
    return import_openvino().Core()


def _cannot_load(file: Path, program: str, error: Exception) -> WeightsError:
    if isinstance(error, OSError) and error.strerror:
        return WeightsError(f"{file}: {error.strerror}")
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return WeightsError(f"{file}: {program} cannot load it: {lines[-1] if lines else type(error).__name__}")
