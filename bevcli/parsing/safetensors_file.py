"""Reads the tensors of a .safetensors file. The format holds plain data only; the library checks its sizes."""

from __future__ import annotations

from pathlib import Path

import safetensors
from torch import Tensor

from bevcli.errors import BevcliError, InputError
from bevcli.parsing.files import open_regular


def read_safetensors(
    path: Path, *, missing: str = "the file is missing", error: type[BevcliError] = InputError
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors by name, on the CPU, and the metadata.

    missing: text of the message for a file that is not there.
    error: kind of exception for a file that is missing, damaged or no regular file.
    """
    open_regular(path, missing=missing, error=error).close()  # the library would wait for the writer of a pipe
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            return tensors, dict(file.metadata() or {})
    except (safetensors.SafetensorError, OSError, ValueError, RuntimeError, AttributeError) as failure:
        reason = " ".join(str(failure).split())
        raise error(f"{path}: not a valid safetensors file ({reason:.200})") from None
