"""Velocities of annotated objects from their positions over time."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array

MAX_GAP_S = 1.5  # longest time between two annotations of an object from which a velocity is derived


def velocities_between(centers: Array, times_s: Array, first: NDArray[np.int64], last: NDArray[np.int64]) -> Array:
    """(A, 3) m/s, NaN if unknown: central differences, one-sided for an object's first and last annotation.

    As in the official nuScenes devkit, a velocity is known if each time gap is at most 1.5 s on average.

    centers: (A, 3) metres, world frame. times_s: (A,) seconds. first, last: (A,) rows of the annotations of the same
    object before and after; the own row where there is none.
    """
    rows = np.arange(len(centers))
    seconds = times_s[last] - times_s[first]
    longest = MAX_GAP_S * ((first != rows).astype(int) + (last != rows))
    known = (seconds > 0) & (seconds <= longest)
    with np.errstate(divide="ignore", invalid="ignore"):
        velocities: Array = (centers[last] - centers[first]) / seconds[:, None]
    return np.where(known[:, None], velocities, np.nan)


def with_track_velocities(frames: Sequence[Boxes3D], timestamps_ns: Sequence[int]) -> list[Boxes3D]:
    """The boxes of T frames, in the world frame, with the velocities that follow from their `instances`; "" is none.

    timestamps_ns: (T,) increasing.
    """
    together = Boxes3D.concatenate(frames)
    if together.instances is None:
        return list(frames)
    counts = [len(boxes) for boxes in frames]
    seconds = np.repeat((np.asarray(timestamps_ns) - timestamps_ns[0]) * 1e-9, counts)
    order = np.lexsort((seconds, together.instances))
    names = together.instances[order]
    same = (names[1:] == names[:-1]) & (names[1:] != "")
    first, last = np.arange(len(order)), np.arange(len(order))
    first[order[1:][same]], last[order[:-1][same]] = order[:-1][same], order[1:][same]
    velocities = velocities_between(together.centers, seconds, first, last)[:, :2]
    parts = np.split(velocities, np.cumsum(counts)[:-1])
    return [replace(boxes, velocities=own) for boxes, own in zip(frames, parts, strict=True)]
