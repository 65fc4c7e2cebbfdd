"""The same operations, faster: backends of deformable attention and convolution, and oneDNN layers."""

import contextlib
import threading
from collections.abc import Iterator
from typing import Any

import torch

_SETTING = threading.RLock()  # the precision of products is a setting of the process


@contextlib.contextmanager
def rounded_products(device_type: str, *, enabled: bool = True) -> Iterator[None]:
    """Inside, factors are rounded: on a device of kind "cpu" to bfloat16, on a "cuda" GPU to TF32 (10 bits).

    Sums and results stay in float32.
    """
    if not enabled:
        yield
        return
    setting: Any = torch.backends.mkldnn.matmul if device_type == "cpu" else torch.backends.cuda.matmul  # type: ignore[attr-defined]
    rounded: tuple[str, Any] = ("fp32_precision", "bf16" if device_type == "cpu" else "tf32")
    if not hasattr(setting, rounded[0]):  # PyTorch before 2.9, on a GPU
        rounded = ("allow_tf32", True)
    name, value = rounded
    with _SETTING:
        before = getattr(setting, name)
        setattr(setting, name, value)
        try:
            yield
        finally:
            setattr(setting, name, before)
