"""The packages of the extras `bevcli[onnx]` and `bevcli[openvino]`, which a plain installation lacks."""

from __future__ import annotations

from importlib.util import find_spec

from bevcli.errors import BevcliError


def require(*names: str, extra: str = "onnx") -> None:
    """Raises BevcliError where one of these packages is not installed. extra: of bevcli, which installs them."""
    missing = [name for name in names if find_spec(name) is None]
    if missing:
        raise BevcliError(f"{', '.join(missing)}: not installed; run pip install 'bevcli[{extra}]'")
