"""Writes a frame in the background while the model computes the next one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import TypeVar

from bevcli.waiting import result_within

S = TypeVar("S")
T = TypeVar("T")
TIMEOUT_S = 120.0  # of writing one frame


def write_behind(work: Callable[[S], T], items: Iterable[S]) -> Iterator[tuple[S, T]]:
    """Yields every item with work(item), in order. While a background thread works on an item, the next one is made.

    Work on an item begins when the one before has been yielded and the caller asks for the next. If making an item
    fails, the one before is yielded first. If the caller stops early, no work is done on the item that was made since.
    An exception in `work` is raised when its item is due; WaitError if it takes more than 120 s.
    """
    source = iter(items)
    pool = ThreadPoolExecutor(1, thread_name_prefix="write-behind")
    pending: tuple[S, Future[T]] | None = None
    try:
        while True:
            made: list[S] = []
            failure: BaseException | None = None
            try:
                made.append(next(source))
            except StopIteration:
                pass
            except BaseException as error:
                failure = error
            if pending is not None:
                yield pending[0], result_within(pending[1], TIMEOUT_S, "writing a frame")
            if failure is not None:
                raise failure
            if not made:
                return
            pending = made[0], pool.submit(work, made[0])
    finally:
        if pending is not None:
            wait((pending[1],), TIMEOUT_S)
        pool.shutdown(wait=False)
