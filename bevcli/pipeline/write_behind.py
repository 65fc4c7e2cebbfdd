"""Writes a frame in the background while the model computes the next one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

S = TypeVar("S")
T = TypeVar("T")


def write_behind(work: Callable[[S], T], items: Iterable[S]) -> Iterator[tuple[S, T]]:
    """Yields every item with work(item), in order. While a background thread works on an item, the next one is made.

    Work on an item begins when the one before has been yielded and the caller asks for the next. If making an item
    fails, the one before is yielded first. If the caller stops early, no work is done on the item that was made since.
    An exception in `work` is raised when its item is due.
    """
    source = iter(items)
    with ThreadPoolExecutor(1, thread_name_prefix="write-behind") as pool:
        pending: tuple[S, Future[T]] | None = None
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
                yield pending[0], pending[1].result()
            if failure is not None:
                raise failure
            if not made:
                return
            pending = made[0], pool.submit(work, made[0])
