"""Frames that several processes make, in order."""

import multiprocessing
import signal
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any

from bevcli.errors import BevcliError, OutputError

Make = Callable[[Sequence[int]], Iterable[Any]]  # makes the items at some indices
BLOCK = 4  # at most; neighbouring frames that a process makes: they share the scenery around the vehicle


@contextmanager
def shared_out(make: Make, count: int, workers: int) -> Generator[Iterator[Any], None, None]:
    """The items 0 to count - 1, in order, made in `workers` processes, which end with the `with` block.

    make: can be pickled. What it raises is raised here.
    Raises OutputError where a process ends before its items are made.
    """
    block = min(BLOCK, -(-count // workers))
    parts = [[k for k in range(count) if k // block % workers == worker] for worker in range(workers)]
    processes: list[SpawnProcess] = []
    try:
        with blocked_interrupts():
            connections = [_started(make, part, processes) for part in filter(None, parts)]
        with closing(_in_order(dict(zip(connections, filter(None, parts), strict=True)))) as items:
            yield items
    finally:
        for process in processes:
            process.kill()
            process.join()


@contextmanager
def blocked_interrupts() -> Iterator[None]:
    """Processes that start in the block never see Ctrl-C: it reaches their parent, which ends them."""
    resource_tracker.ensure_running()  # it would be started with the first process, and unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _started(make: Make, part: Sequence[int], processes: list[SpawnProcess]) -> Connection:
    """Start a process that sends its items, and append it to `processes`. Returns the connection to read from."""
    context = multiprocessing.get_context("spawn")
    reader, writer = context.Pipe(duplex=False)
    process = context.Process(target=_send_all, args=(writer, make, part), daemon=True)
    process.start()
    processes.append(process)
    writer.close()  # so that the end of the process is the end of what can be read
    return reader


def _in_order(indices_of: dict[Connection, list[int]]) -> Generator[Any, None, None]:
    """What arrives through the connections, in the order of the indices of each."""
    left = {connection: iter(indices) for connection, indices in indices_of.items()}
    waiting: dict[int, Any] = {}
    for index in range(sum(map(len, indices_of.values()))):
        while index not in waiting:
            ready: list[Any] = wait(left)
            for connection in ready:
                at = next(left[connection], None)
                if at is None:
                    del left[connection]
                else:
                    waiting[at] = _received(connection)
        yield waiting.pop(index)


def _received(connection: Connection) -> Any:
    try:
        item = connection.recv()
    except (EOFError, ConnectionError):
        raise OutputError("a worker process ended early (out of memory?): use fewer `workers`") from None
    if isinstance(item, BaseException):
        raise item
    return item


def _send_all(connection: Connection, make: Make, part: Sequence[int]) -> None:
    with suppress(BrokenPipeError):  # the process that reads has ended
        try:
            for item in make(part):
                connection.send(item)
        except BevcliError as error:
            connection.send(error)
