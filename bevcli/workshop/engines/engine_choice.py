"""`EngineChoice`: the engine that is asked for a model that is named, in place of PyTorch.

The times of engines on this machine, as `bevcli bench --engines` has measured them, are in the user's cache.
"""

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import msgspec
import torch

from bevcli.errors import BevcliError, InputError
from bevcli.inference.machine import describe_machine
from bevcli.inference.options import AUTO, TORCH, ModelOptions
from bevcli.model.config import ModelConfig
from bevcli.parsing.files import MIB, read_bytes
from bevcli.registry import entries, load
from bevcli.workshop.engines.engine import Engine, installed_engines, require
from bevcli.workshop.engines.export_form import export_form
from bevcli.workshop.engines.file_cache import engines_folder
from bevcli.writing import write_whole

EXPORTERS = ("onnx", "onnxscript")  # packages that write the file
QUANTIZER = "onnxruntime"  # the package that makes it INT8, whatever engine runs it
SPEEDS = "speeds.json"


@dataclass(frozen=True)
class EngineChoice:
    """The engine that a model is to run in, once its rig is known: see `in_engine`.

    Attributes:
        engine: AUTO, or the name of an engine.
        precision: of backbone and neck.
        calibrate_with: drive whose first frames calibrate INT8; None for the drive that is run.
    """

    engine: str
    precision: Literal["fp32", "int8"]
    calibrate_with: Path | None = None

    def resolve(self, config: ModelConfig) -> str:
        """The engine. AUTO is the fastest one that was measured, else PyTorch, or with INT8 the first one installed.

        Raises BevcliError where INT8 needs an engine and none is installed.
        """
        if self.engine != AUTO:
            return self.engine
        known = installed_engines() if _can_export(config) else {}
        measured = fastest_engine(config, self.precision)
        if measured in known:
            return str(measured)
        if self.precision == "fp32":
            return TORCH
        require(*EXPORTERS, QUANTIZER)
        if not known:
            export_form(config, len(config.cameras))  # says why it cannot be exported
            raise BevcliError("`precision=int8`: no engine is installed: run pip install 'bevcli[openvino]'")
        return next(iter(known))


def engine_choice(options: ModelOptions, config: ModelConfig, device: torch.device) -> EngineChoice | None:
    """The engine that the options ask for; None for PyTorch. device: where PyTorch would run.

    Raises BevcliError for an engine that is unknown, not installed, or cannot run the model, and for options that
    exclude each other.
    """
    engine, precision = options.engine, options.precision
    if options.calibrate_with is not None and precision != "int8":
        raise BevcliError("`calibrate_with`: is for `precision=int8`")
    if precision == "int8" and engine == TORCH:
        raise BevcliError("`precision=int8`: PyTorch has no INT8 here: choose another `engine`, or leave it out")
    if engine in (None, TORCH) and precision != "int8":
        return None
    if engine in (None, AUTO):
        if precision == "int8" and str(options.device) not in ("auto", "cpu"):
            raise BevcliError(f"`precision=int8`: runs on the CPU: leave out `device={options.device}`")
        if precision not in (None, "fp32", "int8") or (precision is None and device.type != "cpu"):
            return None
        return EngineChoice(AUTO, precision or "fp32", options.calibrate_with)
    known = list(entries("bevcli.engines"))
    if engine not in known:
        raise BevcliError(f"`engine={engine}`: unknown engine (expected {', '.join((AUTO, TORCH, *known))})")
    chosen: type[Engine] = load("bevcli.engines", engine)
    if precision not in (None, "fp32", "int8"):
        raise BevcliError(f"`precision={precision}`: `engine={engine}` computes in fp32 or int8")
    if str(options.device) not in ("auto", "cpu"):
        raise BevcliError(f"`device={options.device}`: `engine={engine}` runs on the CPU: leave out one of them")
    chosen.require_packages()
    require(*EXPORTERS, *((QUANTIZER,) if precision == "int8" else ()))
    export_form(config, len(config.cameras))
    return EngineChoice(engine, precision or "fp32", options.calibrate_with)


def _can_export(config: ModelConfig) -> bool:
    try:
        require(*EXPORTERS)
        export_form(config, len(config.cameras))
    except BevcliError:
        return False
    return True


def fastest_engine(config: ModelConfig, precision: str) -> str | None:
    """The engine that was the fastest one here for a model in a precision; None where none was measured."""
    measured = _read().get(_key(config), {})
    times = {name.split()[0]: seconds for name, seconds in measured.items() if name.split()[1:] == [precision]}
    return min(times, key=times.__getitem__, default=None)


def remember_speeds(config: ModelConfig, speeds: Mapping[str, float]) -> None:
    """Keep the times of a model on this machine: "ENGINE PRECISION" -> seconds of a frame. Raises OutputError."""
    content = msgspec.json.format(msgspec.json.encode({**_read(), _key(config): speeds}), indent=1)
    write_whole(engines_folder() / SPEEDS, content + b"\n", parents=True, shared=True)


def _key(config: ModelConfig) -> str:
    """The machine and the model, whatever its weights and its name are."""
    facts = repr(replace(config, name=""))
    return f"{describe_machine(torch.device('cpu'))}, {hashlib.sha256(facts.encode()).hexdigest()[:16]}"


def _read() -> dict[str, Mapping[str, float]]:
    """All times; none where the file is missing or broken: they are measured anew."""
    with suppress(InputError, msgspec.MsgspecError, ValueError, RecursionError):
        return msgspec.json.decode(read_bytes(engines_folder() / SPEEDS, MIB), type=dict[str, dict[str, float]])
    return {}
