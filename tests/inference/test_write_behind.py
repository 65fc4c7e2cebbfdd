import threading

import pytest

from bevcli.inference.pipeline import QUEUE, WriteBehind


def write_behind(work, items, depth=QUEUE):
    with WriteBehind(work, depth) as writer:
        for item in items:
            if not writer.put(item):
                break


def test_every_item_is_worked_on_in_order():
    worked = []
    write_behind(lambda item: worked.append(item) or True, range(20))
    write_behind(lambda item: worked.append(item) or True, [])
    assert worked == list(range(20))


def test_items_are_made_while_the_first_one_is_worked_on():
    made, all_made = [], threading.Event()

    def items():
        for item in range(4):
            made.append(item)
            yield item
        all_made.set()

    def work(item):
        return all_made.wait(5)

    write_behind(work, items(), depth=3)
    assert made == list(range(4))
    assert all_made.is_set()


def test_no_more_items_are_made_than_may_wait():
    made, most = [], []

    def items():
        for item in range(20):
            made.append(item)
            yield item

    def work(item):
        most.append(len(made) - item)
        return True

    write_behind(work, items(), depth=2)
    assert max(most) <= 4  # the one worked on, two that wait, and one that was made meanwhile


def test_no_item_is_worked_on_after_work_says_so():
    worked, made = [], threading.Event()

    def items():
        yield from range(4)
        made.set()
        yield from range(4, 1000)

    def work(item):
        worked.append(item)
        made.wait(5)
        return item < 2

    write_behind(work, items(), depth=4)
    assert worked == [0, 1, 2]


@pytest.mark.parametrize("kind", [OSError, KeyboardInterrupt])
def test_made_items_are_worked_on_before_the_failure_of_the_next(kind):
    worked = []

    def items():
        yield from range(3)
        raise kind("no image")

    with pytest.raises(kind, match="no image"):
        write_behind(lambda item: worked.append(item) or True, items())
    assert worked == [0, 1, 2]


def test_after_an_error_in_the_work_nothing_more_is_done():
    worked = []

    def work(item):
        worked.append(item)
        return bool(1 / (1 - item))

    with pytest.raises(ZeroDivisionError):
        write_behind(work, range(1000))
    assert worked == [0, 1]
