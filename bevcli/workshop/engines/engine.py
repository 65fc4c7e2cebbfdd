"""Engines: ONNX Runtime and OpenVINO on the CPU, with one interface, which brings all that bevcli does with one.

A model that is named is exported for a rig once. The files lie in $XDG_CACHE_HOME/bevcli/engines (default
~/.cache/bevcli/engines). A file is written aside and renamed, so that several processes may make it at the same time.
Files that nobody has used for some months are removed.
"""

import importlib
import logging
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np
import torch

from bevcli._version import __version__
from bevcli.errors import BevcliError, ConfigError, InputError, WeightsError
from bevcli.frame import Drive, Frame, FrameStamp
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Pose
from bevcli.inference import ModelOptions
from bevcli.inference.load import Model, tracker_of_table
from bevcli.inference.preprocess import Preprocessor
from bevcli.model import AnyPrecision
from bevcli.model.config import ModelConfig
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution
from bevcli.model.pillar_projection import Pillars
from bevcli.model.temporal_model import model_class
from bevcli.parsing.files import MIB, hash_of_values, read_bytes
from bevcli.printing import one_line
from bevcli.sequences.images import AT_REST
from bevcli.sequences.open import open_sequence, select_range
from bevcli.workshop.engines import OnnxOptions
from bevcli.workshop.engines.export_form import DeformableConvolution
from bevcli.workshop.engines.export_onnx import (
    EXPORTERS,
    QUANTIZERS,
    calibration_images,
    check_size,
    export_onnx,
    imported,
    quantize,
    require,
)
from bevcli.workshop.engines.exported import Arrays, ExportedModel, LoadedFile, for_rig
from bevcli.writing import user_cache, whole_file, write_whole

FORMAT = 1  # of the files in the cache; increase it when they change in one version of bevcli
KEY_DIGITS = 20
UNUSED_S = 90 * 24 * 3600.0
CALIBRATION_FRAMES = 16
ONCE = "once for these weights, number of cameras and image size"


class Engine(LoadedFile):
    """A program that runs exported files. An instance is a file, loaded.

    An engine is registered under `bevcli.engines`: a subclass, made from the file and a number of threads, that sets
    the attributes of `LoadedFile` and has its `forward`.

    Attributes:
        packages: that it needs.
        extra: of bevcli, which installs them.
        precisions: that a named model can have in it, see `in_precision`.
        rank: of the engines that are installed, the lowest is taken for INT8 where none is named.
        deformable_convolution: as `OnnxOptions.deformable_convolution`, for files that are exported for it.
    """

    packages: ClassVar[tuple[str, ...]] = ()
    extra: ClassVar[str] = "onnx"
    precisions: ClassVar[tuple[AnyPrecision, ...]] = ("fp32", "int8")
    rank: ClassVar[int] = 2
    deformable_convolution: ClassVar[DeformableConvolution] = "operator"

    def __init__(self, file: Path, threads: int) -> None:
        """Raises BevcliError where the program is not installed, WeightsError for a file that it cannot load."""
        super().__init__()
        self.require_packages()

    @classmethod
    def require_packages(cls) -> None:
        """Raises BevcliError where a package that it needs is not installed."""
        require(*cls.packages, extra=cls.extra)

    @classmethod
    def in_precision(cls, precision: str) -> "type[Engine]":
        """The class that computes in one of `precisions`. Files in INT8 state it themselves."""
        return cls

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
            weights = f"`weights={options.weights}` (`--weights`)"
            option = "`untrained` (`--untrained`)" if options.untrained else weights
            raise WeightsError(f"{file}: an exported file holds its weights: leave out {option}")
        if options.precision is not None:
            raise BevcliError(
                f"`precision={options.precision}` (`--precision`): {file} has a fixed precision: leave out the option "
                "(bevcli quantize writes files with INT8)"
            )
        if str(options.device) not in ("auto", "cpu"):
            raise BevcliError(f"`device={options.device}` (`--device`): {file} runs on the CPU: leave out the option")
        network = cls.open(file)
        metadata = network.metadata
        return Model(
            network,
            precision=metadata.precision,
            weights=None if metadata.untrained else file,
            bundled=metadata.bundled,
            tracker=tracker_of_table(metadata.contents, metadata.config, str(file)),
            engine=name,
            file=file,
        )

    @classmethod
    def check_options(cls, name: str, options: ModelOptions, config: ModelConfig) -> None:
        """Raises BevcliError where the engine, `name`, is not installed or cannot run a model with these options."""
        if options.precision not in (None, *cls.precisions):
            precisions = " or ".join(cls.precisions)
            raise BevcliError(
                f"`precision={options.precision}` (`--precision`): `engine={name}` (`--engine {name}`) computes in "
                f"{precisions}"
            )
        if str(options.device) not in ("auto", "cpu"):
            raise BevcliError(
                f"`device={options.device}` (`--device`): `engine={name}` (`--engine {name}`) runs on the CPU: leave "
                "out the option"
            )
        cls.in_precision(options.precision or "fp32").require_packages()
        require(*EXPORTERS, *(QUANTIZERS if options.precision == "int8" else ()))
        model_class(config).export_form(config, len(config.cameras))

    @classmethod
    def export(cls, model: Model, rig: CameraRig, drive: Drive | None) -> Model:
        """A model that is loaded for this engine, as an exported file for a rig: see `Model.in_engine`."""
        sized = for_rig(model, rig)
        options = _options(sized, rig, cls.deformable_convolution)
        exact, is_int8 = CachedFile(_key(sized, options, "fp32")), model.precision == "int8"
        file, engine = exact, cls.in_precision(model.precision)
        if is_int8:
            file = CachedFile(_key(sized, options, "int8", CALIBRATION_FRAMES))  # perhaps of an earlier, longer drive
            if not file.stamp:  # then of this drive: longer ones do not use the file of a short one
                file = CachedFile(_key(sized, options, "int8", len(_calibration_frames(model, drive).stamps)))
        cached = file.load(engine)
        if cached is None:
            frames = _calibration_frames(model, drive) if is_int8 else None
            cached = exact.load(engine) if is_int8 else None
            if cached is None:
                _note(f"exporting {model.name} for {options.cameras} cameras to {model.engine}, {ONCE}")
                labels = {"untrained": model.untrained, "bundled": model.bundled}
                with exact.written() as path:
                    export_onnx(sized.network, path, options, contents=sized.contents(), **labels)
                cached = exact.opened(engine)
            if frames is not None:
                _note(f"calibrating {model.name} with {frames.name}, {ONCE}")
                images = calibration_images(sized.config, cached[0].cameras, [frames], CALIBRATION_FRAMES)
                with file.written() as path:
                    quantize(exact.path, images, path)
                cached = file.opened(engine, frames.name)
        network, calibrated_with = cached
        calibrated = f", calibrated with {calibrated_with}" if calibrated_with else ""
        note = f"engine {model.engine}, {model.precision}{calibrated}; the exported file is {file.path}"
        return replace(model, network=network, file=file.path, engine_note=note)


def _note(text: str) -> None:
    """Tell that work begins which takes some time."""
    logging.getLogger("bevcli").warning("note: %s", one_line(text))


class OnnxRuntimeEngine(Engine):
    """ONNX Runtime on the CPU, in the precision of the file."""

    packages = ("onnxruntime",)
    rank = 1

    def __init__(self, file: Path, threads: int) -> None:
        super().__init__(file, threads)
        (onnxruntime,) = imported("onnxruntime")
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
    precisions = ("fp32", "bf16", "int8")
    rank = 0  # the fastest one in INT8 on every processor that was measured
    deformable_convolution = "gridsample"  # it lacks DeformConv
    hint: ClassVar[str] = "f32"

    def __init__(self, file: Path, threads: int) -> None:
        super().__init__(file, threads)
        (onnx,) = imported("onnx")
        settings: dict[str, Any] = {
            # By default OpenVINO rounds everything to bfloat16 where the CPU has it, which moves boxes by decimetres.
            "INFERENCE_PRECISION_HINT": self.hint,
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
        self.outputs = tuple(port.name for port in proto.graph.output)  # a port may have names of OpenVINO's too
        self.request = self.model.create_infer_request()

    def forward(self, feed: Arrays) -> dict[str, np.ndarray]:
        outputs = self.request.infer(dict(feed), share_inputs=True)
        return {name: outputs[name] for name in self.outputs}

    @classmethod
    def in_precision(cls, precision: str) -> type[Engine]:
        return RoundingOpenVinoEngine if precision == "bf16" else cls


class RoundingOpenVinoEngine(OpenVinoEngine):
    """OpenVINO on the CPU; it rounds what a file in float32 computes to bfloat16, in the whole model."""

    hint = "bf16"

    @classmethod
    def require_packages(cls) -> None:
        """As `Engine.require_packages`; raises BevcliError for a processor without bfloat16 too."""
        super().require_packages()
        if "BF16" not in _openvino_core().get_property("CPU", "OPTIMIZATION_CAPABILITIES"):
            raise BevcliError(
                "`precision=bf16` (`--precision bf16`): OpenVINO has no bfloat16 on this processor: leave it out"
            )


@cache
def _openvino_core() -> Any:
    """OpenVINO's one core of this process, without telemetry, which is never deleted.

    When it is imported for the first time, openvino sends a message to Google Analytics by the package
    openvino_telemetry. Without that package it takes a stub, which sends nothing.

    On a processor with AMX each core sets a stack for signals and, when it is deleted, restores the one before, which
    another core may have freed. The next Ctrl-C would then end the process with a segmentation fault (2026.4).
    """
    hidden = "openvino_telemetry"
    before = sys.modules.get(hidden)
    sys.modules[hidden] = None  # type: ignore[assignment]  # import then raises ImportError
    try:
        return importlib.import_module("openvino").Core()
    finally:
        if before is None:
            del sys.modules[hidden]
        else:
            sys.modules[hidden] = before


def _cannot_load(file: Path, program: str, error: Exception) -> WeightsError:
    if isinstance(error, OSError) and error.strerror:
        return WeightsError(f"{file}: {error.strerror}")
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return WeightsError(f"{file}: {program} cannot load it: {lines[-1] if lines else type(error).__name__}")


def _calibration_frames(model: Model, drive: Drive | None) -> Drive:
    if model.calibrate_with is not None:
        drive = open_sequence(model.calibrate_with, rate_hz=model.config.rate_hz, ground_truth=False)
    if drive is None:
        raise InputError(
            "`precision=int8` (`--precision int8`): there are no frames to calibrate with: pass `calibrate_with` "
            "(`--int8-drive DRIVE`)"
        )
    return select_range(drive, slice(0, CALIBRATION_FRAMES))


def _key(sized: Model, options: OnnxOptions, precision: str, frames: int = 0) -> str:
    """Hash of all that a file depends on. frames: number of those that calibrate it."""
    other = sized.calibrate_with if precision == "int8" else None
    inputs = {
        "version": (__version__, FORMAT),
        "weights": sized.weights_hash,
        "model": sized.config_hash,
        "labels": (sized.untrained, sized.bundled),
        "options": repr(options),
        "precision": precision,
        "calibration": (frames, None if other is None else str(other.resolve())),
    }
    return hash_of_values(inputs)[:KEY_DIGITS]


class FileFacts(msgspec.Struct, frozen=True):
    """The facts of a file: its SHA-256, hexadecimal, and the name of the drive that calibrated it, "" for float32."""

    sha256: str
    calibrated_with: str = ""


@dataclass(frozen=True)
class CachedFile:
    """A file of the cache. key: hash of everything that its contents depend on."""

    key: str

    @property
    def path(self) -> Path:
        """The exported file."""
        return user_cache() / "engines" / f"{self.key}.onnx"

    @property
    def facts_path(self) -> Path:
        """The file with its facts."""
        return self.path.with_suffix(".json")

    @property
    def stamp(self) -> tuple[object, ...]:
        """Inodes and sizes of the file and its facts, which change with them; empty where one is missing."""
        try:
            stats = [path.stat() for path in (self.path, self.facts_path)]
        except OSError:
            return ()
        return (self.path, *((stat.st_ino, stat.st_size) for stat in stats))

    def load(self, engine: type[Engine]) -> tuple[ExportedModel, str] | None:
        """The file in an engine, and the name of the drive that calibrated it, "" for float32.

        None where it is missing or broken. Raises BevcliError for a missing engine.
        """
        return _load(self, engine, self.stamp)  # type: ignore[arg-type]  # mypy takes a class for its instances

    @contextmanager
    def written(self) -> Iterator[Path]:
        """A path for the contents of the file, which takes its place after the block. Raises OutputError."""
        for path in self.path.parent.glob("*.onnx") if self.path.parent.is_dir() else ():
            with suppress(OSError):
                if time.time() - path.stat().st_mtime > UNUSED_S:
                    path.unlink()
                    path.with_suffix(".json").unlink(missing_ok=True)
        with whole_file(self.path, parents=True, regular=True) as unfinished:
            yield unfinished

    def opened(self, engine: type[Engine], calibrated_with: str = "") -> tuple[ExportedModel, str]:
        """The file in an engine, after it was written; its facts are kept beside it."""
        network = engine.open(self.path)
        file_facts = FileFacts(bytes(network.digest.tolist()).hex(), calibrated_with)
        write_whole(self.facts_path, msgspec.json.encode(file_facts), regular=True)
        return network, calibrated_with


@lru_cache(maxsize=1)
def _load(file: CachedFile, engine: type[Engine], stamp: object) -> tuple[ExportedModel, str] | None:
    """See `CachedFile.load`; the last file is kept for the next drive."""
    if not stamp:
        return None
    try:
        file_facts = msgspec.json.decode(read_bytes(file.facts_path, MIB, error=WeightsError), type=FileFacts)
        network = engine.open(file.path)
    except (msgspec.MsgspecError, ValueError, RecursionError, WeightsError, ConfigError):
        return None
    if bytes(network.digest.tolist()).hex() != file_facts.sha256:
        return None
    with suppress(OSError):  # a cache that cannot be written can be read
        os.utime(file.path)
    return network, file_facts.calibrated_with


def _options(sized: Model, rig: CameraRig, deformable_convolution: DeformableConvolution) -> OnnxOptions:
    """The options of a file for a rig: its number of cameras, and the largest number of them that see one cell."""
    deformable = any(isinstance(module, ModulatedDeformableConvolution) for module in sized.network.modules())
    pose = Pose.identity()
    still = Frame(FrameStamp(0, "", 0), rig, {}, pose, dict.fromkeys(rig.names, pose), AT_REST)
    frame = Preprocessor(sized.config)(still)  # without images
    everywhere = torch.ones_like(frame.has_image)
    height, width = frame.images.shape[-2:]
    hit = Pillars(sized.config.bev_grid).project(frame.image_from_bev.float(), (height, width), everywhere).hit
    return OnnxOptions(
        deformable_convolution=deformable_convolution if deformable else OnnxOptions.deformable_convolution,
        cameras=frame.images.shape[1],
        cameras_per_cell=max(int(hit.sum(1).max()), OnnxOptions.cameras_per_cell),
    )
