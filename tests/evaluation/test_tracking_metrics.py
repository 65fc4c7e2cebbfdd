"""The tracking metrics are those of the nuScenes devkit, also at ties; hand-made cases show what each counts."""

import gzip
import itertools
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_boxes import made_boxes

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.workshop.scores.tracking import TrackingScores, evaluate_tracking

GOLDEN = Path(__file__).parents[1] / "data" / "golden_tracking.json.gz"  # made with nuscenes-devkit 1.2.0
Row = tuple[str, float, float]  # identity, x, y
VARIANTS = ({}, {"ground_truth": "bus"}, {"predictions": "trailer"}, {"ground_truth": "bus", "predictions": "trailer"})


@pytest.fixture(scope="module")
def golden() -> dict[str, Any]:
    return json.loads(gzip.decompress(GOLDEN.read_bytes()))


def golden_scores(golden: dict[str, Any], without: dict[str, str]) -> TrackingScores:
    """The scores of the golden file's boxes, less those of one class on one side."""
    stamps = [FrameStamp(row["frame"], row["scene"], row["timestamp_us"] * 1000) for row in golden["frames"]]

    def frames(side: str, identity: str) -> list[Boxes3D]:
        rows = defaultdict(list)
        for row in golden[side]:
            if row["class"] != without.get(side):
                rows[row["scene"], row["frame"]].append(row)
        return [golden_boxes(rows[stamp.scene, stamp.index], identity) for stamp in stamps]

    ego_xy = np.array([row["ego_translation"][:2] for row in golden["frames"]])
    return evaluate_tracking(
        frames("predictions", "tracking_id"), frames("ground_truth", "instance"), stamps, ego_xy=ego_xy
    )


def golden_boxes(rows: list[dict[str, Any]], identity: str) -> Boxes3D:
    if not rows:
        return Boxes3D.empty()
    columns = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    return Boxes3D(
        columns["translation"],
        columns["size_lwh"],
        columns["yaw"],
        columns["velocity"],
        columns["class"],
        instances=columns[identity],
        track_scores=columns.get("tracking_score"),
        num_points=columns["num_points"],
    )


def number(value: float | None) -> float:
    return np.nan if value is None else value


@pytest.mark.parametrize("without", VARIANTS, ids=str)
def test_every_number_equals_the_devkits(golden: dict[str, Any], without: dict[str, str]) -> None:
    scores = golden_scores(golden, without)
    expected = golden["expected"]
    if without:
        dropped = {f"drop_{side}_of": name for side, name in without.items()}
        expected = next(v["expected"] for v in golden["variants"] if v.keys() - {"expected"} == dropped.keys())
    for metric, classes in expected["label_metrics"].items():
        for name, value in classes.items():
            found = scores.classes[name].metrics[metric]
            assert found == pytest.approx(number(value), abs=1e-9, nan_ok=True), (metric, name)
    for metric, value in expected["mean_metrics"].items():
        assert scores.overall[metric] == pytest.approx(number(value), abs=1e-9, nan_ok=True), metric
    for name, metrics in expected.get("per_threshold", {}).items():
        for metric, values in metrics.items():
            levels = scores.classes[name].levels[metric]
            np.testing.assert_allclose(levels, [*map(number, values)], atol=1e-9, rtol=0, err_msg=f"{metric} of {name}")


def cars(rows: list[Row], score: float | None = None) -> Boxes3D:
    names = np.array([name for name, _, _ in rows], dtype=np.str_)
    return made_boxes([place for _, *place in rows], instances=names, track_scores=score)


def car_scores(predicted: list[list[Row]], truth: list[list[Row]], scenes: str | None = None) -> TrackingScores:
    """The scores of frames half a second apart; the ego vehicle stands at the origin."""
    scenes = "a" * len(truth) if scenes is None else scenes
    stamps = [FrameStamp(k, scene, k * 500_000_000) for k, scene in enumerate(scenes)]
    return evaluate_tracking([cars(rows, 0.9) for rows in predicted], [cars(rows) for rows in truth], stamps)


def two_cars(left: str = "A", right: str = "B", frames: int = 10, apart: float = 6.0) -> list[list[Row]]:
    """Two cars side by side; `left` and `right` name each car's identity, one letter for all frames or one a frame."""
    left, right = (name * frames if len(name) == 1 else name for name in (left, right))
    return [[(left[k], k, apart / 2), (right[k], k, -apart / 2)] for k in range(frames)]


def metrics(scores: TrackingScores) -> dict[str, float]:
    return dict(scores.classes["car"].metrics)


def test_perfect_tracks_have_amota_one_and_no_error():
    found = metrics(car_scores(two_cars("s", "t"), two_cars()))
    assert (found["amota"], found["mota"], found["recall"], found["mt"]) == (1, 1, 1, 2)
    assert [found[name] for name in ("amotp", "motp", "ids", "frag", "fp", "fn", "ml", "tid", "lgd")] == [0] * 9


def test_exchanged_identities_are_two_switches():
    found = metrics(car_scores(two_cars("sssssttttt", "tttttsssss"), two_cars()))
    assert (found["ids"], found["tp"], found["mota"], found["motar"], found["frag"]) == (2, 18, 0.9, 1, 0)
    assert found["amota"] == 35 / 40  # the scores of 18 matches reach 35 of the 40 recall levels


def test_frames_may_come_in_any_order():
    truth, predicted = two_cars(), two_cars("sssssttttt", "tttttsssss")
    stamps = [FrameStamp(k, "a", k * 500_000_000) for k in range(10)]
    order = np.random.default_rng(0).permutation(10)
    shuffled = evaluate_tracking(
        [cars(predicted[k], 0.9) for k in order], [cars(truth[k]) for k in order], [stamps[k] for k in order]
    )
    assert metrics(shuffled) == metrics(car_scores(predicted, truth))


def test_boxes_beyond_the_range_of_their_class_do_not_count():
    truth = [[("A", 10, 0), ("B", 50, 0)] for _ in range(5)]
    found = metrics(car_scores([[("s", 10, 0), ("t", 50.1, 0)] for _ in range(5)], truth))
    assert (found["gt"], found["fp"], found["amota"]) == (5, 0, 1)


def test_predictions_without_an_identity_are_left_out():
    found = metrics(car_scores([[("s", 0, 0), ("", 20, 0)]] * 3, [[("A", 0, 0)]] * 3))
    assert (found["tp"], found["fp"]) == (3, 0)


def test_without_ground_truth_everything_is_nan():
    scores = car_scores([[("s", 0, 0)]], [[]])
    assert all(np.isnan(value) for value in metrics(scores).values())
    assert np.isnan(scores.overall["amota"])


def test_one_identity_twice_in_a_frame_is_an_error():
    with pytest.raises(InputError, match='predictions: scene "a" frame 1: two boxes have the instance "s"'):
        car_scores([[("s", 0, 0)], [("s", 0, 0), ("s", 9, 0)]], [[("A", 0, 0)]] * 2)


def test_boxes_without_an_identity_cannot_be_scored():
    with pytest.raises(InputError, match='ground truth: scene "a" frame 1: 1 of 2 boxes have no "instance"'):
        car_scores([[("s", 0, 0)]] * 2, [[("A", 0, 0)], [("A", 0, 0), ("", 9, 0)]])
    with pytest.raises(InputError, match='predictions: no box has an "instance"'):
        car_scores([[("", 0, 0)]], [[("A", 0, 0)]])


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
    scores = [score for _, score in rows]
    return made_boxes(centers, sizes_lwh=2.0, instances=numbers.astype(str), track_scores=scores)


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
