"""Switches the garbage collector off while millions of small objects are read."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Inside the block, the collector does not run: it would scan all parsed JSON objects again and again.

    Without it, reading a boxes file takes half the time, and nuScenes tables two thirds.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
