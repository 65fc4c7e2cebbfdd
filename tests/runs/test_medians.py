"""The summary's medians are right to half a per cent, and take the same memory for any number of frames."""

import numpy as np
import pytest

from bevcli.runs.summary import RunningMedian


@pytest.mark.parametrize("count", [1, 2, 3, 10, 1001, 20_000])
def test_the_median_is_right_to_half_a_per_cent(count):
    seconds = np.random.default_rng(count).lognormal(-2.0, 1.0, count)
    median = RunningMedian()
    for value in seconds:
        median.add(float(value))
    expected = np.sort(seconds)[(count - 1) // 2]
    assert median.value() == pytest.approx(expected, rel=0.0051)
    assert median.count == count
    assert median.total_s == pytest.approx(seconds.sum())
    assert len(median.bins) < 1000  # from 1 µs to a quarter of an hour there are 2,070 bins


def test_without_values_or_at_a_time_of_zero_the_median_is_given():
    assert RunningMedian().value() == 0.0
    median = RunningMedian()
    median.add(0.0)
    assert median.value() == pytest.approx(1e-6, rel=0.01)
