"""Prepares the next frames in the background while the model computes the current one."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

S = TypeVar("S")
T = TypeVar("T")


def read_ahead(work: Callable[[S], T], items: Iterable[S], depth: int = 2, threads: int = 1) -> Iterator[T]:
    """Yields work(item) for every item, in order, computed in background threads up to `depth` items ahead.

    An exception in `work` is raised when its item is due. If the caller stops early, the items that have not begun
    are cancelled.
    """
    source = iter(items)
    pool = ThreadPoolExecutor(threads, thread_name_prefix="read-ahead")
    pending: deque[Future[T]] = deque(pool.submit(work, item) for item in islice(source, depth))
    try:
        while pending:
            result = pending.popleft().result()
            pending.extend(pool.submit(work, item) for item in islice(source, 1))
            yield result
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
