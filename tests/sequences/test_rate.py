"""Thinning keeps the frames nearest to a regular beat."""

import numpy as np
import pytest

from bevcli.frame import FrameStamp
from bevcli.sequences.rate import every, thin


def stamps(seconds, scene="a", start=1_533_151_603_000_000_000):
    return [FrameStamp(i, scene, start + round(s * 1e9)) for i, s in enumerate(seconds)]


@pytest.mark.parametrize(("rate", "step"), [(12, 6), (10, 5), (4, 2), (30, 15)])
def test_a_multiple_of_the_rate_is_thinned_evenly(rate, step):
    thinning = thin(stamps(np.arange(10 * rate) / rate), 2.0)
    assert thinning.places == tuple(range(0, 10 * rate, step))
    assert f"{len(thinning.places)} of {10 * rate}" in thinning.note


def test_jittering_keyframes_are_all_kept():
    rng = np.random.default_rng(1)
    times = np.arange(40) * 0.5 + rng.uniform(-0.05, 0.05, 40)
    assert thin(stamps(times), 2.0).places == tuple(range(40))


def test_each_kept_frame_is_the_nearest_to_its_beat():
    rng = np.random.default_rng(2)
    times = np.cumsum(rng.uniform(0.02, 0.2, 300))
    times -= times[0]
    kept = times[list(thin(stamps(times), 2.0).places)]
    beats = np.arange(0, times[-1] + 0.25, 0.5)
    nearest = {float(times[np.argmin(np.abs(times - beat))]) for beat in beats}
    assert set(kept.tolist()) <= nearest
    assert len(kept) >= len(nearest) - 1


def test_frames_that_do_not_divide_average_to_the_rate():
    kept = thin(stamps(np.arange(300) / 7.0), 2.0).places
    assert len(kept) == pytest.approx(300 / 7 * 2, abs=1.5)


def test_a_hole_in_the_recording_makes_no_frames():
    times = [*np.arange(24) / 12, *(10 + np.arange(24) / 12)]
    kept = [times[place] for place in thin(stamps(times), 2.0).places]
    assert kept == [0, 0.5, 1, 1.5, 10, 10.5, 11, 11.5]


def test_slower_input_is_kept_whole_and_warned_of():
    thinning = thin(stamps(np.arange(5.0)), 2.0)
    assert thinning.places == (0, 1, 2, 3, 4)
    assert "1 frames a second" in thinning.note


def test_input_at_the_rate_says_nothing():
    assert thin(stamps(np.arange(5) / 2), 2.0).note == ""


def test_scenes_begin_anew():
    both = stamps(np.arange(13) / 12, "a") + stamps(np.arange(13) / 12 + 100.3, "b")
    assert thin(both, 2.0).places == (0, 6, 12, 13, 19, 25)
    assert every(both, 5) == (0, 5, 10, 13, 18, 23)


def test_a_single_frame_is_kept():
    assert thin(stamps([0.0]), 2.0).places == (0,)
