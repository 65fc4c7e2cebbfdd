"""While the model computes a frame, other threads prepare the next ones and write those before."""

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from itertools import islice
from typing import Any, Generic, TypeVar

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


class WriteBehind(AbstractContextManager["WriteBehind[S]"], Generic[S]):
    """`with WriteBehind(work) as writer: writer.put(item)`: work(item) of every item, in order, in a background thread.

    Nothing more is done once `work` has returned False or raised. `put` or the end of the block raises its exception.
    The end of the block waits for all items, also after an error in the block.
    Raises WaitError if an item takes more than WRITING_TIMEOUT_S.
    """

    def __init__(self, work: Callable[[S], bool], depth: int = QUEUE) -> None:
        """depth: items that may wait, beside the one that is worked on."""
        self._work, self._depth, self._goes_on = work, depth, True
        self._pending: deque[Future[None]] = deque()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="write-behind")

    def put(self, item: S) -> bool:
        """Add an item, and wait while too many of them are pending. False once `work` has returned False."""
        self._pending.append(self._pool.submit(self._write, item))
        self._finish(1 + self._depth)
        return self._goes_on

    def __exit__(self, *_error: object) -> None:
        try:
            self._finish(0)
        finally:
            for task in self._pending:
                task.cancel()
            wait(self._pending, WRITING_TIMEOUT_S)
            self._pool.shutdown(wait=False)

    def _write(self, item: S) -> None:
        try:
            self._goes_on = self._goes_on and self._work(item)
        except BaseException:
            self._goes_on = False
            raise

    def _finish(self, allowed: int) -> None:
        """Wait until at most `allowed` items are pending. An exception of a finished item is raised."""
        while self._pending and (len(self._pending) > allowed or self._pending[0].done()):
            result_within(self._pending[0], WRITING_TIMEOUT_S, "writing a frame")
            self._pending.popleft()
