"""A submission follows the rules that the nuScenes devkit checks when it reads one; they are restated here."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_boxes import made_boxes

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D, attributes_by_speed
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.geometry.transforms import Pose, yaw_of_quaternion
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes
from bevcli.workshop.formats.submission import SubmissionWriter, is_submission, read_submission, write_submission

ALLOWED_ATTRIBUTES = {
    "pedestrian": {"pedestrian.moving", "pedestrian.sitting_lying_down", "pedestrian.standing"},
    "bicycle": {"cycle.with_rider", "cycle.without_rider"},
    "motorcycle": {"cycle.with_rider", "cycle.without_rider"},
    "barrier": {""},
    "traffic_cone": {""},
}
VEHICLE_ATTRIBUTES = {"vehicle.moving", "vehicle.parked", "vehicle.stopped"}


def many_boxes(count: int, seed: int = 0) -> Boxes3D:
    rng = np.random.default_rng(seed)
    velocities = rng.normal(0, 0.3, (count, 2))
    velocities[::7] = np.nan
    return Boxes3D(
        centers=rng.uniform(-50, 50, (count, 3)),
        sizes_lwh=rng.uniform(0.3, 8, (count, 3)),
        yaws=rng.uniform(-math.pi, math.pi, count),
        velocities=velocities,
        classes=rng.choice(tuple(NUSCENES_CLASSES), count),
        scores=rng.uniform(0, 1, count),
    )


def assert_numbers(box: dict[str, Any]) -> None:
    for key, length in (("translation", 3), ("size", 3), ("rotation", 4), ("velocity", 2)):
        assert len(box[key]) == length
        assert all(type(number) is float and math.isfinite(number) for number in box[key])


def assert_valid(submission: dict[str, Any], tokens: set[str]) -> None:
    assert set(submission) == {"meta", "results"}
    flags = {"use_camera", "use_lidar", "use_radar", "use_map", "use_external"}
    assert set(submission["meta"]) == flags
    assert all(type(submission["meta"][flag]) is bool for flag in flags)
    assert set(submission["results"]) == tokens
    for token, boxes in submission["results"].items():
        assert len(boxes) <= 500
        for box in boxes:
            assert box["sample_token"] == token
            assert_numbers(box)
            assert box["detection_name"] in NUSCENES_CLASSES
            assert type(box["detection_score"]) is float
            allowed = ALLOWED_ATTRIBUTES.get(box["detection_name"], VEHICLE_ATTRIBUTES)
            assert box["attribute_name"] in allowed


def frame(index: int, boxes: Boxes3D, **extras: Any) -> FrameBoxes:
    return FrameBoxes(FrameStamp(index, "s", index), Pose.identity(), boxes, extras)


def test_the_devkits_rules_are_followed(tmp_path: Path) -> None:
    boxes = many_boxes(620)
    rows = (
        frame(0, boxes, sample_token="t0"),
        frame(1, many_boxes(1)),  # between keyframes: no token
        frame(2, Boxes3D.empty(), sample_token="t2"),
    )
    write_submission(BoxesFile("world", rows), tmp_path / "results_nusc.json")
    submission = json.loads((tmp_path / "results_nusc.json").read_text())
    assert_valid(submission, {"t0", "t2"})
    assert submission["meta"]["use_camera"] is True
    written = submission["results"]["t0"]
    assert boxes.scores is not None
    best = np.sort(boxes.scores)[::-1][:500]
    np.testing.assert_array_equal([box["detection_score"] for box in written], best)
    first = int(np.argmax(boxes.scores))
    assert written[0]["translation"] == boxes.centers[first].tolist()
    assert written[0]["size"] == boxes.sizes_lwh[first][[1, 0, 2]].tolist()  # width, length, height
    assert yaw_of_quaternion(written[0]["rotation"]) == pytest.approx(boxes.yaws[first])


def test_a_submission_is_valid_after_every_frame(tmp_path: Path) -> None:
    path = tmp_path / "results_nusc.json"
    with SubmissionWriter(path) as writer:
        for count in range(3):
            assert [f.extras["sample_token"] for f in read_submission(path).frames] == [f"t{i}" for i in range(count)]
            assert is_submission(path)
            writer.write(frame(count, many_boxes(5), sample_token=f"t{count}"))
    assert_valid(json.loads(path.read_text()), {"t0", "t1", "t2"})


@pytest.mark.parametrize(
    ("class_name", "slow", "fast"),
    [
        ("car", "vehicle.parked", "vehicle.moving"),
        ("truck", "vehicle.parked", "vehicle.moving"),
        ("bus", "vehicle.stopped", "vehicle.moving"),
        ("bicycle", "cycle.without_rider", "cycle.with_rider"),
        ("motorcycle", "cycle.without_rider", "cycle.with_rider"),
        ("pedestrian", "pedestrian.standing", "pedestrian.moving"),
        ("traffic_cone", "", ""),
        ("barrier", "", ""),
    ],
)
def test_attributes_follow_from_class_and_speed(class_name: str, slow: str, fast: str) -> None:
    velocities = [[0.1, 0.17], [0.15, 0.15], [np.nan, np.nan]]  # 0.197, 0.212 m/s, unknown
    boxes = made_boxes(np.zeros((3, 3)), class_name, velocities=velocities)
    assert attributes_by_speed(boxes).tolist() == [slow, fast, slow]


def test_a_submission_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "results_nusc.json"
    boxes = many_boxes(20)
    write_submission(BoxesFile("world", (frame(0, boxes, sample_token="t0"),)), path)
    assert is_submission(path)
    found = read_submission(path)
    assert found.frame_of_reference == "world"
    assert found.frames[0].extras["sample_token"] == "t0"
    assert boxes.scores is not None
    best_first = boxes[np.argsort(-boxes.scores)]
    np.testing.assert_allclose(found.frames[0].boxes.centers, best_first.centers)
    np.testing.assert_allclose(found.frames[0].boxes.sizes_lwh, best_first.sizes_lwh)
    np.testing.assert_allclose(found.frames[0].boxes.yaws, best_first.yaws)
    assert found.frames[0].boxes.classes.tolist() == best_first.classes.tolist()


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("translation", [1, 2], "sample t0: box 0: center: expected 3 numbers"),
        ("rotation", [0, 0, 0, 0], "sample t0: box 0: rotation: expected 4 numbers of norm 1"),
        ("detection_name", 3, "sample t0: box 0: class: expected a name"),
        ("detection_score", None, "sample t0: box 0: score"),
    ],
)
def test_a_wrong_submission_is_named(tmp_path: Path, key: str, value: Any, message: str) -> None:
    path = tmp_path / "results_nusc.json"
    write_submission(BoxesFile("world", (frame(0, many_boxes(1), sample_token="t0"),)), path)
    content = json.loads(path.read_text())
    content["results"]["t0"][0][key] = value
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=message):
        read_submission(path)


def test_boxes_without_sample_token_or_world_frame_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match='needs a "sample_token"'):
        write_submission(BoxesFile("world", (frame(0, many_boxes(1)),)), tmp_path / "a.json")
    with pytest.raises(InputError, match="these are in the ego frame"):
        write_submission(BoxesFile("ego", (frame(0, many_boxes(1), sample_token="t"),)), tmp_path / "a.json")
    assert not (tmp_path / "a.json").exists()


def tracked_boxes(count: int, seed: int) -> Boxes3D:
    boxes = many_boxes(count, seed)
    instances = np.array([str(k) if k % 4 else "" for k in range(count)])
    scores = np.where(instances == "", np.nan, np.random.default_rng(seed).uniform(0, 1, count))
    return replace(boxes, instances=instances, track_scores=scores)


def test_a_tracking_submission_keeps_the_devkits_rules(tmp_path: Path) -> None:
    rows = (
        frame(0, tracked_boxes(1200, 1), sample_token="t0"),
        frame(1, tracked_boxes(8, 2)),  # between keyframes: no token
        frame(2, Boxes3D.empty(), sample_token="t2"),
    )
    path = tmp_path / "tracking_nusc.json"
    write_submission(BoxesFile("world", rows), path, tracking=True)
    submission = json.loads(path.read_text())
    assert set(submission) == {"meta", "results"}
    assert set(submission["results"]) == {"t0", "t2"}
    written = submission["results"]["t0"]
    assert len(written) == 500
    keys = {"sample_token", "translation", "size", "rotation", "velocity", "tracking_id", "tracking_name"}
    for box in written:
        assert set(box) == keys | {"tracking_score"}
        assert type(box["tracking_id"]) is str
        assert type(box["tracking_score"]) is float
        assert box["tracking_name"] in {"bicycle", "bus", "car", "motorcycle", "pedestrian", "trailer", "truck"}
        assert_numbers(box)
    scores = [box["tracking_score"] for box in written]
    assert scores == sorted(scores, reverse=True)
    assert len({box["tracking_id"] for box in written}) == 500


def test_a_tracking_submission_is_read_back(tmp_path: Path) -> None:
    boxes = tracked_boxes(40, 3)
    boxes = boxes[(boxes.instances != "") & (boxes.classes == "car")]
    path = tmp_path / "tracking_nusc.json"
    write_submission(BoxesFile("world", (frame(0, boxes, sample_token="t"),)), path, tracking=True)
    assert is_submission(path)
    read = read_submission(path).frames[0].boxes
    assert boxes.track_scores is not None
    order = np.argsort(-boxes.track_scores)
    assert list(read.instances) == list(boxes.instances[order])
    assert read.track_scores == pytest.approx(boxes.track_scores[order])
    assert read.centers == pytest.approx(boxes.centers[order])


def test_a_tracking_submission_needs_tracks(tmp_path: Path) -> None:
    file = BoxesFile("world", (frame(0, many_boxes(3), sample_token="t"),))
    with pytest.raises(InputError, match="bevcli run --track"):
        write_submission(file, tmp_path / "out.json", tracking=True)
