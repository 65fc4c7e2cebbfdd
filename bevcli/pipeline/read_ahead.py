"""Prepares the next frames in the background while the model computes the current one."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

from bevcli.waiting import result_within

S = TypeVar("S")
T = TypeVar("T")
TIMEOUT_S = 1800.0  # of all images of a frame, or of a training step


def read_ahead(
    work: Callable[[S], T], items: Iterable[S], depth: int = 2, threads: int = 1, timeout_s: float = TIMEOUT_S
) -> Iterator[T]:
    """Yields work(item) for every item, in order, computed in background threads up to `depth` items ahead.

    An exception in `work` is raised when its item is due. If the caller stops early, the items that have not begun
    are cancelled. Raises WaitError if an item is not there `timeout_s` seconds after it is due.
    """
    source = iter(items)
    pool = ThreadPoolExecutor(threads, thread_name_prefix="read-ahead")
    pending: deque[Future[T]] = deque(pool.submit(work, item) for item in islice(source, depth))
    try:
        while pending:
            result = result_within(pending.popleft(), timeout_s, "reading and preparing a frame")
            pending.extend(pool.submit(work, item) for item in islice(source, 1))
            yield result
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
