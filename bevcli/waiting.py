"""Waits with a time limit. A disk, a network folder or another program may never answer."""

from concurrent.futures import Future, TimeoutError as FutureTimeout
from typing import TypeVar

from bevcli.errors import WaitError

T = TypeVar("T")


def result_within(future: Future[T], seconds: float, what: str) -> T:
    """The result of a task in another thread. An exception of the task is raised here.

    what: what the task does, for the error message: "reading frame 7".
    Raises WaitError if the task takes longer. Its thread goes on.
    """
    try:
        return future.result(seconds)
    except FutureTimeout:
        if future.done():  # the exception of the task itself, such as a network folder's time-out
            raise
        raise WaitError(f"{what}: no answer within {seconds:.0f} s") from None
