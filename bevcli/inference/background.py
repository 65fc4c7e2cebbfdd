"""While the model computes a frame, other threads prepare the next ones and write those before."""

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import islice
from typing import Any, TypeVar

from bevcli.waiting import result_within

S = TypeVar("S")
T = TypeVar("T")
READING_TIMEOUT_S = 1800.0  # of all images of a frame, or of a training step
WRITING_TIMEOUT_S = 120.0  # of one frame
QUEUE = 4  # frames that wait to be written; each of them keeps its images and its BEV map in memory


def read_ahead(
    work: Callable[[T], S],
    items: Iterable[Any],
    depth: int = 2,
    threads: int = 1,
    load: Callable[[Any], T] | None = None,
) -> Generator[S]:
    """Yields work(item) for every item, in order, computed in background threads up to `depth` items ahead.

    An exception in `work` or `load` is raised when its item is due. If the caller stops early, the items that have not
    begun are cancelled. Raises WaitError if an item is not there READING_TIMEOUT_S after it is due.

    load: makes what `work` takes of an item, in one more thread, in order. None: `work` takes the items.
    """
    what, source = "reading and preparing a frame", iter(items)
    pool = ThreadPoolExecutor(threads, thread_name_prefix="read-ahead")
    loader = None if load is None else ThreadPoolExecutor(1, thread_name_prefix="load-ahead")

    def begun(item: Any) -> Future[S]:
        if loader is None or load is None:
            return pool.submit(work, item)
        loaded = loader.submit(load, item)
        return pool.submit(lambda: work(result_within(loaded, READING_TIMEOUT_S, what)))

    pending = deque(map(begun, islice(source, depth)))
    try:
        while pending:
            result = result_within(pending.popleft(), READING_TIMEOUT_S, what)
            pending.extend(map(begun, islice(source, 1)))
            yield result
    finally:
        for threaded in (pool, loader):
            if threaded is not None:
                threaded.shutdown(wait=False, cancel_futures=True)


def write_behind(work: Callable[[S], bool], items: Iterable[S], depth: int = QUEUE) -> None:
    """Calls work(item) for every item, in order, in a background thread, until it returns False.

    Meanwhile the next items are made, until `depth` of them wait. If making an item fails or is interrupted, those
    before it are worked on first. After an exception in `work`, which is raised here, nothing more is done. Raises
    WaitError if an item takes more than WRITING_TIMEOUT_S.
    """
    goes_on = True
    pending: deque[Future[None]] = deque()
    pool = ThreadPoolExecutor(1, thread_name_prefix="write-behind")

    def write(item: S) -> None:
        nonlocal goes_on
        try:
            goes_on = goes_on and work(item)
        except BaseException:
            goes_on = False
            raise

    def finish(allowed: int) -> None:
        """Wait until only so many items are unfinished; an exception of another one is raised."""
        while pending and (len(pending) > allowed or pending[0].done()):
            result_within(pending[0], WRITING_TIMEOUT_S, "writing a frame")
            pending.popleft()

    try:
        try:
            for item in items:
                pending.append(pool.submit(write, item))
                finish(1 + depth)
                if not goes_on:
                    break
        finally:
            finish(0)
    finally:
        for task in pending:
            task.cancel()
        wait(pending, WRITING_TIMEOUT_S)
        pool.shutdown(wait=False)
