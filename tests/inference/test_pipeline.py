"""Reading ahead and writing behind: order, depth and errors."""

import threading
from itertools import islice

import pytest

from bevcli.config import load_config
from bevcli.inference.pipeline import read_ahead, write_behind
from bevcli.inference.runner import AHEAD_BYTES, frames_ahead


def test_several_threads_keep_the_order():
    late = threading.Event()

    def work(item):
        if item == 0:
            late.wait(5)  # the first item is done after the second
        else:
            late.set()
        return item

    assert list(read_ahead(work, range(6), depth=4, threads=3)) == list(range(6))


def test_an_error_is_raised_at_its_item_and_not_before():
    results = read_ahead(lambda x: 1 / (2 - x), range(5))
    assert [next(results), next(results)] == [0.5, 1.0]
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_it_works_ahead_of_the_consumer_but_only_so_far():
    started = []
    reached = threading.Event()

    def work(item):
        started.append(item)
        if item == 3:
            reached.set()
        return item

    results = read_ahead(work, range(100), depth=3)
    assert next(results) == 0
    assert reached.wait(5)
    assert max(started) == 3


def test_items_are_loaded_in_order_in_one_thread_of_their_own():
    loaded, threads = [], set()

    def load(item):
        loaded.append(item)
        threads.add(threading.get_ident())
        return item + 1

    results = list(read_ahead(lambda x: (x, threading.get_ident()), range(12), depth=5, threads=3, load=load))
    assert [x for x, _ in results] == list(range(1, 13))
    assert loaded == list(range(12))
    assert len(threads) == 1
    assert threads.isdisjoint(thread for _, thread in results)


@pytest.mark.parametrize("cameras", [1, 6, 60])
def test_frames_ahead_of_a_gpu_are_bounded_by_their_memory(cameras):
    image = load_config("base").image
    width, height = image.padded_size
    depth, threads = frames_ahead(image, cameras, cores=16)
    assert depth == 2 or depth * cameras * width * height * 3 * 4 <= AHEAD_BYTES
    assert 1 <= threads <= 16
    assert frames_ahead(image, cameras, cores=1)[1] == 1


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
