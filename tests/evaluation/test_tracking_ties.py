"""Boxes whose score is the threshold itself count as they do in the devkit, to the last bit of a track's mean score."""

import itertools
from collections import defaultdict

import numpy as np
import pytest

from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.workshop.scores.tracking import evaluate_tracking

FRAMES, PERIOD_NS = 60, 500_000_000


@pytest.mark.parametrize("seed", range(6))
def test_a_box_at_the_threshold_counts_as_in_the_devkit(seed):
    truth, found = standing_objects(np.random.default_rng(seed))
    stamps = [FrameStamp(number, "scene", number * PERIOD_NS) for number in range(FRAMES)]
    scores = evaluate_tracking(boxes(found), boxes(truth), stamps, ego_xy=np.zeros((FRAMES, 2)))
    levels = devkit_levels(truth, found)
    np.testing.assert_array_equal(scores.classes["car"].levels["confidence"], [level[0] for level in levels])
    assert scores.classes["car"].metrics["amota"] == pytest.approx(np.mean([level[1] for level in levels]), abs=1e-12)


def standing_objects(rng):
    """Tracks of objects and of false detections, 8 m apart: name -> {frame: score}; scores have one or two digits."""
    truth, found = {}, {}
    for number in range(64):
        length = int(rng.integers(8, FRAMES + 1))
        frames = np.arange(length) + rng.integers(0, FRAMES - length + 1)
        if number % 2:
            truth[number] = dict.fromkeys(frames, 0.0)
        if rng.random() < 0.85:
            kept = [frame for frame in frames if frame in (frames[0], frames[-1]) or rng.random() < 0.8]
            found[number] = dict(zip(kept, (0.3 + rng.integers(0, 4, len(kept)) / 10).round(1), strict=True))
    return truth, found


def boxes(tracks):
    frames = defaultdict(list)
    for number, scores in tracks.items():
        for frame, score in scores.items():
            frames[frame].append((number, score))
    return [frame_boxes(frames[frame]) for frame in range(FRAMES)]


def frame_boxes(rows):
    if not rows:
        return Boxes3D.empty()
    numbers = np.array([number for number, _ in rows])
    centers = np.stack([numbers % 8 * 8.0 - 28, numbers // 8 * 8.0 - 28, np.zeros(len(rows))], axis=1)
    return Boxes3D(
        centers,
        np.full((len(rows), 3), 2.0),
        np.zeros(len(rows)),
        np.zeros((len(rows), 2)),
        np.full(len(rows), "car"),
        instances=numbers.astype(str),
        track_scores=np.array([score for _, score in rows]),
    )


def devkit_levels(truth, found):
    """(threshold, MOTAR) of the 40 levels, the highest recall first, by plain loops over the devkit's formulas."""
    given = sum(max(frames) - min(frames) + 1 for number, frames in truth.items() if near(number))
    scores = {number: interpolated(frames) for number, frames in found.items() if near(number)}
    matched = [score for number in scores.keys() & truth.keys() for frame, score in scores[number].items()]
    recalls = np.linspace(0.1, 1, 40).round(12)
    reached = np.arange(1, len(matched) + 1) / given
    thresholds = np.interp(recalls, reached, sorted(matched, reverse=True))
    thresholds[recalls > reached[-1]] = np.nan
    return [(threshold, motar(threshold, truth, scores)) for threshold in thresholds[::-1]]


def near(number):
    return np.hypot(number % 8 * 8.0 - 28, number // 8 * 8.0 - 28) < 50


def interpolated(frames):
    """The score of each frame of a track: its mean, and the devkit's weighted sum of both neighbours in gaps."""
    mean = np.mean(list(frames.values()))
    scores = dict.fromkeys(frames, mean)
    places = sorted(frames)
    for left, right in itertools.pairwise(places):
        for frame in range(left + 1, right):
            weight = (right - frame) / (right - left)
            scores[frame] = (1.0 - weight) * mean + weight * mean
    return scores


def motar(threshold, truth, scores):
    kept = {number: sum(score >= threshold for score in frames.values()) for number, frames in scores.items()}
    right = sum(count for number, count in kept.items() if number in truth)
    return max(0.0, 1 - (sum(kept.values()) - right) / right) if right else 0.0
