"""Times of engines on this machine, as `bevcli bench --engines` has measured them, in the user's cache."""

import hashlib
import platform
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import msgspec
import torch

from bevcli.engines.file_cache import engines_folder
from bevcli.errors import InputError
from bevcli.model.config import ModelConfig
from bevcli.parsing.files import MIB, read_bytes
from bevcli.writing import write_whole

FILE = "speeds.json"
Speeds = Mapping[str, float]  # "ENGINE PRECISION" -> seconds of a frame


def describe_machine(device: torch.device) -> str:
    """Name of the processor or GPU, number of threads and PyTorch's version."""
    if device.type == "cuda":
        return f"{torch.cuda.get_device_name(device)}, PyTorch {torch.__version__}"
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    name = names[0] if names else platform.processor() or platform.machine()
    capability = torch.backends.cpu.get_cpu_capability()
    return f"{name} ({capability}), {torch.get_num_threads()} threads, PyTorch {torch.__version__}"


def fastest_engine(config: ModelConfig, precision: str) -> str | None:
    """The engine that was the fastest one here for a model in a precision; None where none was measured."""
    measured = _read().get(_key(config), {})
    times = {name.split()[0]: seconds for name, seconds in measured.items() if name.split()[1:] == [precision]}
    return min(times, key=lambda name: times[name]) if times else None


def remember_speeds(config: ModelConfig, speeds: Speeds) -> None:
    """Keep the times of a model on this machine. Raises OutputError."""
    content = msgspec.json.format(msgspec.json.encode({**_read(), _key(config): speeds}), indent=1)
    write_whole(engines_folder() / FILE, content + b"\n", parents=True, shared=True)


def _key(config: ModelConfig) -> str:
    """The machine and the model, whatever its weights and its name are."""
    facts = repr(replace(config, name=""))
    return f"{describe_machine(torch.device('cpu'))}, {hashlib.sha256(facts.encode()).hexdigest()[:16]}"


def _read() -> dict[str, Speeds]:
    """All times; none where the file is missing or broken: they are measured anew."""
    with suppress(InputError, msgspec.MsgspecError, ValueError, RecursionError):
        return msgspec.json.decode(read_bytes(engines_folder() / FILE, MIB), type=dict[str, dict[str, float]])
    return {}
