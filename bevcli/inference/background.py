"""While the model computes a frame, other threads prepare the next ones and write the one before."""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import islice
from typing import TypeVar

from bevcli.waiting import result_within

S = TypeVar("S")
T = TypeVar("T")
READING_TIMEOUT_S = 1800.0  # of all images of a frame, or of a training step
WRITING_TIMEOUT_S = 120.0  # of one frame


def read_ahead(work: Callable[[S], T], items: Iterable[S], depth: int = 2, threads: int = 1) -> Generator[T]:
    """Yields work(item) for every item, in order, computed in background threads up to `depth` items ahead.

    An exception in `work` is raised when its item is due. If the caller stops early, the items that have not begun
    are cancelled. Raises WaitError if an item is not there READING_TIMEOUT_S after it is due.
    """
    source = iter(items)
    pool = ThreadPoolExecutor(threads, thread_name_prefix="read-ahead")
    pending: deque[Future[T]] = deque(pool.submit(work, item) for item in islice(source, depth))
    try:
        while pending:
            result = result_within(pending.popleft(), READING_TIMEOUT_S, "reading and preparing a frame")
            pending.extend(pool.submit(work, item) for item in islice(source, 1))
            yield result
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def write_behind(work: Callable[[S], T], items: Iterable[S]) -> Iterator[tuple[S, T]]:
    """Yields every item with work(item), in order. While a background thread works on an item, the next one is made.

    Work on an item begins when the one before has been yielded and the caller asks for the next. If making an item
    fails, the one before is yielded first. If the caller stops early, no work is done on the item that was made since.
    An exception in `work` is raised when its item is due; WaitError if it takes more than WRITING_TIMEOUT_S.
    """
    source = iter(items)
    pool = ThreadPoolExecutor(1, thread_name_prefix="write-behind")
    pending: tuple[S, Future[T]] | None = None
    try:
        while True:
            try:
                made = list(islice(source, 1))
            finally:
                if pending is not None:
                    yield pending[0], result_within(pending[1], WRITING_TIMEOUT_S, "writing a frame")
            if not made:
                return
            pending = made[0], pool.submit(work, made[0])
    finally:
        if pending is not None:
            wait((pending[1],), WRITING_TIMEOUT_S)
        pool.shutdown(wait=False)
