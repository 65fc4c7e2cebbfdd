import threading

import pytest

from bevcli.inference.background import write_behind


def test_every_item_comes_with_its_result_in_order():
    assert list(write_behind(lambda x: x * x, range(5))) == [(x, x * x) for x in range(5)]
    assert list(write_behind(lambda x: x, [])) == []


def test_an_item_is_worked_on_while_the_next_one_is_made():
    making, working = threading.Event(), threading.Event()

    def items():
        yield 0
        making.set()
        assert working.wait(5)
        yield 1

    def work(item):
        assert making.wait(5)
        working.set()

    assert [item for item, _ in write_behind(work, items())] == [0, 1]


def test_the_next_work_begins_when_the_caller_asks_for_it():
    """So the caller may read what the work changed."""
    worked = []
    for item, _ in write_behind(worked.append, range(4)):
        assert worked == list(range(item + 1))
        if item == 2:
            break
    assert worked == [0, 1, 2]


def test_a_made_item_comes_before_the_failure_of_the_next():
    worked = []

    def items():
        yield 0
        raise OSError("no image")

    steps = write_behind(worked.append, items())
    assert next(steps)[0] == 0
    with pytest.raises(OSError, match="no image"):
        next(steps)
    assert worked == [0]


def test_an_error_in_the_work_is_raised_at_its_item():
    steps = write_behind(lambda x: 1 / (1 - x), range(3))
    assert next(steps) == (0, 1.0)
    with pytest.raises(ZeroDivisionError):
        next(steps)
