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
from bevcli.workshop.formats.nuscenes_output import SubmissionWriter, is_submission, read_submission, write_submission

ALLOWED_ATTRIBUTES = {
    "pedestrian": {"pedestrian.moving", "pedestrian.sitting_lying_down", "pedestrian.standing"},
    "bicycle": {"cycle.with_rider", "cycle.without_rider"},
    "motorcycle": {"cycle.with_rider", "cycle.without_rider"},
    "barrier": {""},
    "traffic_cone": {""},
}
VEHICLE_ATTRIBUTES = {"vehicle.moving", "vehicle.parked", "vehicle.stopped"}
FURTHER_KEYS = {"detection": "attribute_name", "tracking": "tracking_id"}


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


def assert_valid(submission: dict[str, Any], tokens: set[str], task: str = "detection") -> None:
    assert set(submission) == {"meta", "results"}
    flags = {"use_camera", "use_lidar", "use_radar", "use_map", "use_external"}
    assert set(submission["meta"]) == flags
    assert all(type(submission["meta"][flag]) is bool for flag in flags)
    assert set(submission["results"]) == tokens
    numbers, further = {"translation": 3, "size": 3, "rotation": 4, "velocity": 2}, FURTHER_KEYS[task]
    for token, boxes in submission["results"].items():
        assert len(boxes) <= 500
        for box in boxes:
            assert set(box) == {"sample_token", *numbers, f"{task}_name", f"{task}_score", further}
            assert box["sample_token"] == token
            assert {key: len(box[key]) for key in numbers} == numbers
            values = [number for key in numbers for number in box[key]] + [box[f"{task}_score"]]
            assert all(type(number) is float and math.isfinite(number) for number in values)
            name = box[f"{task}_name"]
            if task == "detection":
                assert name in NUSCENES_CLASSES
                assert box[further] in ALLOWED_ATTRIBUTES.get(name, VEHICLE_ATTRIBUTES)
            else:
                assert name in {"bicycle", "bus", "car", "motorcycle", "pedestrian", "trailer", "truck"}
                assert type(box[further]) is str


def tracked_boxes(count: int, seed: int) -> Boxes3D:
    boxes = many_boxes(count, seed)
    instances = np.array([str(k) if k % 4 else "" for k in range(count)])
    scores = np.where(instances == "", np.nan, np.random.default_rng(seed).uniform(0, 1, count))
    return replace(boxes, instances=instances, track_scores=scores)


def frame(index: int, boxes: Boxes3D, **extras: Any) -> FrameBoxes:
    return FrameBoxes(FrameStamp(index, "s", index), Pose.identity(), boxes, extras)


@pytest.mark.parametrize("task", FURTHER_KEYS)
def test_the_devkits_rules_are_followed(tmp_path: Path, task: str) -> None:
    boxes = many_boxes(620) if task == "detection" else tracked_boxes(1200, 1)
    rows = (
        frame(0, boxes, sample_token="t0"),
        frame(1, boxes[:8]),  # between keyframes: no token
        frame(2, Boxes3D.empty(), sample_token="t2"),
    )
    write_submission(BoxesFile("world", rows), tmp_path / "nusc.json", tracking=task == "tracking")
    submission = json.loads((tmp_path / "nusc.json").read_text())
    assert_valid(submission, {"t0", "t2"}, task)
    assert submission["meta"]["use_camera"] is True
    written = submission["results"]["t0"]
    assert len(written) == 500
    found = [box[f"{task}_score"] for box in written]
    assert found == sorted(found, reverse=True)
    if task == "tracking":
        assert len({box["tracking_id"] for box in written}) == 500
        return
    assert boxes.scores is not None
    first = int(np.argmax(boxes.scores))
    np.testing.assert_array_equal(found, np.sort(boxes.scores)[::-1][:500])
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


@pytest.mark.parametrize("tracking", [False, True])
def test_a_submission_is_read_back(tmp_path: Path, tracking: bool) -> None:
    path, boxes = tmp_path / "nusc.json", many_boxes(20)
    if tracking:
        boxes = tracked_boxes(40, 3)
        boxes = boxes[(boxes.instances != "") & (boxes.classes == "car")]
    write_submission(BoxesFile("world", (frame(0, boxes, sample_token="t0"),)), path, tracking=tracking)
    assert is_submission(path)
    file = read_submission(path)
    found = file.frames[0].boxes
    assert (file.frame_of_reference, file.frames[0].extras["sample_token"]) == ("world", "t0")
    scores = "track_scores" if tracking else "scores"
    best_first = boxes[np.argsort(-getattr(boxes, scores))]
    for name in (scores, "centers", "sizes_lwh", "yaws"):
        np.testing.assert_allclose(getattr(found, name), getattr(best_first, name), err_msg=name)
    assert found.classes.tolist() == best_first.classes.tolist()
    assert not tracking or found.instances.tolist() == best_first.instances.tolist()


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("translation", [1, 2], r"sample t0: boxes\[0\].center: expected `array` of length 3, got 2"),
        ("rotation", [0, 0, 0, 0], "sample t0: box 0: rotation: expected 4 numbers of norm 1"),
        ("detection_name", 3, r"sample t0: boxes\[0\].class: expected `str`, got `int`"),
        ("detection_score", None, r"sample t0: boxes\[0\].score"),
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


def test_a_tracking_submission_needs_tracks(tmp_path: Path) -> None:
    file = BoxesFile("world", (frame(0, many_boxes(3), sample_token="t"),))
    with pytest.raises(InputError, match="bevcli run --track"):
        write_submission(file, tmp_path / "out.json", tracking=True)
