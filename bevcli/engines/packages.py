"""The packages of the extras `bevcli[onnx]` and `bevcli[openvino]`, which a plain installation lacks."""

from __future__ import annotations

import importlib
import sys
from importlib.util import find_spec
from typing import Any

from bevcli.errors import BevcliError


def require(*names: str, extra: str = "onnx") -> None:
    """Raises BevcliError where one of these packages is not installed. extra: of bevcli, which installs them."""
    missing = [name for name in names if find_spec(name) is None]
    if missing:
        raise BevcliError(f"{', '.join(missing)}: not installed; run pip install 'bevcli[{extra}]'")


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
