"""When the messages of a topic were captured, without reading all of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.sequences.ros.bag import Bag, spread
from bevcli.sequences.ros.messages import timestamp_ns, transforms_of

SAMPLES = 5
LARGEST_SPREAD_NS = 50_000_000  # of the delay between capture and recording, among the samples


def capture_times(bag: Bag, topic: str) -> NDArray[np.int64]:
    """(N,) times at which a topic's messages were captured, ns, within about the jitter of their recording.

    The index of a bag has the times of recording only. The delay is taken from a few messages. If it differs much
    among them, such as in a bag that was replayed at another speed, the times of all messages are read.
    """
    logged = bag.times(topic)
    stated = {index: _stated_time(bag, topic, index) for index in spread(len(logged), SAMPLES)}
    delays = [time - int(logged[index]) for index, time in stated.items() if time]
    if not delays:
        return logged
    typical = int(np.median(delays))
    if max(delays) - min(delays) <= LARGEST_SPREAD_NS:
        return logged + typical
    return np.array([_stated_time(bag, topic, index) or int(time) + typical for index, time in enumerate(logged)])


def _stated_time(bag: Bag, topic: str, index: int) -> int:
    """The time that a message states, ns; 0 if it states none, or cannot be read."""
    try:
        message = bag.message(topic, index)
        return timestamp_ns(message) or next((one.timestamp_ns for one in transforms_of(message)), 0)
    except (InputError, AttributeError, ValueError):
        return 0
