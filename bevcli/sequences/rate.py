"""Thinning to the rate that a model was trained at: speed and history depend on the time between frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bevcli.frame import FrameStamp

# Between these ratios to the wanted rate a scene counts as being at that rate: keyframe times jitter.
SLOWEST_RATIO, FASTEST_RATIO = 0.75, 1.5
HOLE_BEATS = 1.5  # a gap longer than so many beats is a hole


@dataclass(frozen=True)
class Thinning:
    """The places (into the stamps) that are kept, and what the user should know, "" for nothing."""

    places: tuple[int, ...]
    note: str


def thin(stamps: Sequence[FrameStamp], rate_hz: float) -> Thinning:
    """Keep, scene by scene, the frames nearest to a regular beat of `rate_hz` that starts at the scene's first frame.

    A scene at about this rate is kept whole; a slower one too, and the note says so.
    """
    kept: list[int] = []
    slowest = np.inf
    for places in scenes_of(stamps):
        times = np.array([stamps[place].timestamp_ns for place in places], dtype=np.int64)
        ratio = median_rate_hz(times) / rate_hz
        slowest = min(slowest, ratio)
        chosen = _nearest_to_beat(times, rate_hz) if ratio > FASTEST_RATIO else range(len(places))
        kept += [places[index] for index in chosen]
    return Thinning(tuple(kept), _note(len(stamps), len(kept), slowest, rate_hz))


def every(stamps: Sequence[FrameStamp], step: int) -> tuple[int, ...]:
    """The places of every `step`-th frame of each scene, from its first."""
    return tuple(place for places in scenes_of(stamps) for place in places[::step])


def scenes_of(stamps: Sequence[FrameStamp]) -> Iterator[list[int]]:
    """The places of each run of frames that share a scene."""
    start = 0
    for place in range(1, len(stamps) + 1):
        if place == len(stamps) or stamps[place].scene != stamps[start].scene:
            yield list(range(start, place))
            start = place


def median_rate_hz(times_ns: np.ndarray) -> float:
    """Frames a second by the middle gap of times (T,) int64 ns; infinite of a single frame, which has no rate."""
    return float(1e9 / np.median(np.diff(times_ns))) if len(times_ns) > 1 else np.inf


def _nearest_to_beat(times_ns: np.ndarray, rate_hz: float) -> list[int]:
    """The beat starts anew after a hole in the recording: there is no frame for the beats in it."""
    seconds = (times_ns - times_ns[0]) / 1e9
    holes = np.flatnonzero(np.diff(seconds) > HOLE_BEATS / rate_hz) + 1
    kept: list[int] = []
    for piece in np.split(np.arange(len(seconds)), holes):
        kept += (piece[0] + _nearest_in_piece(seconds[piece] - seconds[piece[0]], rate_hz)).tolist()
    return kept


def _nearest_in_piece(seconds: np.ndarray, rate_hz: float) -> np.ndarray:
    if len(seconds) == 1:
        return np.zeros(1, dtype=np.int64)
    end = seconds[-1] + 0.5 * np.median(np.diff(seconds))  # a later beat has no frame, and the last is not its own
    beats = np.arange(0, end, 1 / rate_hz)
    later = np.clip(np.searchsorted(seconds, beats), 1, len(seconds) - 1)
    earlier = later - 1
    return np.unique(np.where(beats - seconds[earlier] <= seconds[later] - beats, earlier, later))


def _note(total: int, kept: int, slowest_ratio: float, rate_hz: float) -> str:
    notes = []
    if kept < total:
        notes.append(
            f"{kept} of {total} frames are used, those nearest to {rate_hz:g} a second (--rate all: every one)"
        )
    if slowest_ratio < SLOWEST_RATIO:
        found = f"{slowest_ratio * rate_hz:.2g} frames a second"
        notes.append(f"the input has {found}, fewer than the model's {rate_hz:g}: speeds and history will suffer")
    return "; ".join(notes)
