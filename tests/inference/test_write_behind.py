import threading
from itertools import islice

import pytest

from bevcli.inference.pipeline import write_behind


def test_every_item_is_written_in_order():
    assert list(write_behind(range(20), lambda item: 2 * item)) == list(range(0, 40, 2))
    assert list(write_behind([], lambda item: item)) == []


def test_items_are_made_while_the_first_one_is_written():
    made, all_made = [], threading.Event()

    def items():
        for item in range(4):
            made.append(item)
            yield item
        all_made.set()

    assert all(write_behind(items(), lambda item: all_made.wait(5), depth=3))
    assert made == list(range(4))


def test_no_more_items_are_made_than_may_wait():
    made = []

    def items():
        for item in range(20):
            made.append(item)
            yield item

    most = max(write_behind(items(), lambda item: len(made) - item, depth=2))
    assert most <= 4  # the one worked on, two that wait, and one that was made meanwhile


def test_what_was_made_is_written_where_the_caller_stops():
    made, written = [], []
    steps = write_behind((made.append(item) or item for item in range(1000)), written.append, depth=4)
    list(islice(steps, 3))
    steps.close()
    assert written == made
    assert 3 <= len(made) <= 9


@pytest.mark.parametrize("kind", [OSError, KeyboardInterrupt])
def test_made_items_are_written_before_the_failure_of_the_next(kind):
    written = []

    def items():
        yield from range(3)
        raise kind("no image")

    with pytest.raises(kind, match="no image"):
        list(write_behind(items(), written.append))
    assert written == [0, 1, 2]


def test_nothing_is_written_after_an_error():
    written = []

    def write(item):
        written.append(item)
        return 1 / (1 - item)

    with pytest.raises(ZeroDivisionError):
        list(write_behind(range(1000), write))
    assert written == [0, 1]
