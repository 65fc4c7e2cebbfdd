"""TrackedBoxes: the boxes of many frames with their identities, filtered and interpolated as the devkit does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class TrackedBoxes:
    """N boxes, ordered by frame.

    Attributes:
        frames: (N,) index of each box's frame, rising; frames of a scene are in the order of time.
        tracks: (N,) identity, a number from 0 on; the same name in two scenes has two numbers.
        xy: (N, 2) centre on the ground, metres.
        classes: (N,) names.
        scores: (N,) track scores; 0 for ground truth.
    """

    frames: Indices
    tracks: Indices
    xy: Array
    classes: NDArray[np.str_]
    scores: Array

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, selection: NDArray[Any]) -> TrackedBoxes:
        """The boxes of a mask (N,) bool or of an index array."""
        return TrackedBoxes(
            self.frames[selection],
            self.tracks[selection],
            self.xy[selection],
            self.classes[selection],
            self.scores[selection],
        )


def scored_tracks(
    frames: Sequence[Boxes3D],
    stamps: Sequence[FrameStamp],
    ego_xy: Array,
    ranges_m: Mapping[str, float],
    side: str,
) -> TrackedBoxes:
    """The boxes that are scored: in range, with points, with one score a track, and interpolated in gaps.

    Args:
        frames: F frames of boxes in any order. Boxes without an identity are left out. The score of a box is its track
            score, or its score where it has none.
        stamps: scene and time of each frame.
        ego_xy: (F, 2) position of the ego vehicle in each frame's frame of reference, metres.
        ranges_m: class -> range in metres; boxes of other classes are left out.
        side: "predictions" or "ground truth", for error messages.

    Returns:
        The boxes. `frames` are places in the order of scene and time, see `time_order`.

    Raises:
        InputError: a frame has one identity twice.
    """
    given = [_columns(frames[place], row, ego_xy[place], ranges_m) for row, place in enumerate(time_order(stamps))]
    rows = np.concatenate([columns[0] for columns in given])
    names, classes, xy, scores = (np.concatenate([columns[k] for columns in given]) for k in range(1, 5))
    ordered = [stamps[place] for place in time_order(stamps)]
    scenes = _scene_numbers(ordered)
    _, name_numbers = np.unique(names, return_inverse=True)
    keys = scenes[rows] * (len(names) + 1) + name_numbers
    _, tracks = np.unique(keys, return_inverse=True)
    _require_unique(rows, tracks, names, ordered, side)
    sums = np.bincount(tracks, weights=scores)
    scores = (sums / np.maximum(np.bincount(tracks), 1))[tracks]
    times = np.array([stamp.timestamp_ns for stamp in ordered], dtype=np.int64)
    return _interpolated(TrackedBoxes(rows, tracks, xy, classes, scores), times)


def time_order(stamps: Sequence[FrameStamp]) -> list[int]:
    """The places of frames ordered by scene (in the order of first appearance), then by time."""
    first: dict[str, int] = {}
    for place, stamp in enumerate(stamps):
        first.setdefault(stamp.scene, place)
    return sorted(range(len(stamps)), key=lambda place: (first[stamps[place].scene], stamps[place].timestamp_ns))


def _columns(
    boxes: Boxes3D, row: int, ego_xy: Array, ranges_m: Mapping[str, float]
) -> tuple[Indices, NDArray[np.str_], NDArray[np.str_], Array, Array]:
    """Frame, identity, class, position and score of the boxes of a frame that are scored."""
    limits = np.array([ranges_m.get(str(name), -1.0) for name in boxes.classes])
    away = np.linalg.norm(boxes.centers[:, :2] - ego_xy, axis=1)
    kept = away < limits
    if boxes.num_points is not None:
        kept &= boxes.num_points != 0
    names = np.full(len(boxes), "") if boxes.instances is None else boxes.instances
    kept &= names != ""
    scores = boxes.scores if boxes.track_scores is None else boxes.track_scores
    scores = np.zeros(len(boxes)) if scores is None else scores
    rows = np.full(int(kept.sum()), row, dtype=np.int64)
    return rows, names[kept], boxes.classes[kept], boxes.centers[kept, :2], scores[kept]


def _scene_numbers(ordered: Sequence[FrameStamp]) -> Indices:
    numbers: dict[str, int] = {}
    return np.array([numbers.setdefault(stamp.scene, len(numbers)) for stamp in ordered], dtype=np.int64)


def _require_unique(
    rows: Indices, tracks: Indices, names: NDArray[np.str_], ordered: Sequence[FrameStamp], side: str
) -> None:
    order = np.lexsort((tracks, rows))
    same = (np.diff(rows[order]) == 0) & (np.diff(tracks[order]) == 0)
    if same.any():
        box = order[int(np.argmax(same))]
        stamp = ordered[rows[box]]
        raise InputError(
            f'{side}: scene "{stamp.scene}" frame {stamp.index}: two boxes have the instance "{names[box]}" '
            "(expected one box for each object)"
        )


def _interpolated(boxes: TrackedBoxes, times_ns: Indices) -> TrackedBoxes:
    """Adds a box to every frame inside a track in which the track has none.

    As in the devkit, the weight of the right neighbour is (t_right - t) / (t_right - t_left): the nearer neighbour
    counts less in gaps of several frames. New boxes come last in their frame, by their track's first appearance.
    """
    order = np.lexsort((boxes.frames, boxes.tracks))
    left, right = order[:-1], order[1:]
    missing = np.where(boxes.tracks[left] == boxes.tracks[right], boxes.frames[right] - boxes.frames[left] - 1, 0)
    left, right = np.repeat(left, missing), np.repeat(right, missing)
    step = np.arange(len(left)) - np.repeat(np.cumsum(missing) - missing, missing) + 1
    frames = boxes.frames[left] + step
    span = times_ns[boxes.frames[right]] - times_ns[boxes.frames[left]]
    weight = (times_ns[boxes.frames[right]] - times_ns[frames]) / span
    xy = (1 - weight)[:, None] * boxes.xy[left] + weight[:, None] * boxes.xy[right]
    scores = (1 - weight) * boxes.scores[left] + weight * boxes.scores[right]
    first_appearance = np.full(int(boxes.tracks.max(initial=-1)) + 1, len(boxes))
    np.minimum.at(first_appearance, boxes.tracks, np.arange(len(boxes)))
    added = TrackedBoxes(frames, boxes.tracks[right], xy, boxes.classes[right], scores)
    added = added[np.argsort(first_appearance[added.tracks], kind="stable")]
    both = TrackedBoxes(
        np.concatenate([boxes.frames, added.frames]),
        np.concatenate([boxes.tracks, added.tracks]),
        np.concatenate([boxes.xy, added.xy]),
        np.concatenate([boxes.classes, added.classes]),
        np.concatenate([boxes.scores, added.scores]),
    )
    return both[np.argsort(both.frames, kind="stable")]
