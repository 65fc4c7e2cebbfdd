"""Boxes files: what is written is read back, mistakes are named in one line, and frames of two files are paired."""

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_boxes import as_predictions, random_truth

from bevcli.errors import InputError, OutputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import default_ego_from_bev
from bevcli.geometry.transforms import Pose, inverse, rigid, rotation_about_z
from bevcli.sequences.files.boxes_file import BoxesFile, BoxesWriter, FrameBoxes, read_boxes
from bevcli.workshop.scores.detection import evaluate_detections
from bevcli.workshop.scores.inputs import FramePairs, pair_frames

POSE = Pose(np.array([600.25, -3.5, 0.125]), np.array([-0.6, 0.0, 0.0, 0.8]))


def some_boxes() -> Boxes3D:
    return Boxes3D(
        centers=np.array([[1.0, 2.0, 3.0], [1e3 / 3, -5.0, 0.1]]),
        sizes_lwh=np.array([[4.5, 1.9, 1.6], [0.5, 0.6, 1.7]]),
        yaws=np.array([0.1, -3.0]),
        velocities=np.array([[1.5, -0.5], [np.nan, np.nan]]),
        classes=np.array(["car", "pedestrian"]),
        scores=np.array([0.9, 1 / 3]),
        attributes=np.array(["vehicle.moving", ""]),
        instances=np.array(["a", ""]),
        visibilities=np.array([0.25, np.nan]),
        num_points=np.array([7, -1]),
    )


def frame(index: int, boxes: Boxes3D, **extras: Any) -> FrameBoxes:
    return FrameBoxes(FrameStamp(index, "street", 1_533_151_603_547_590_000 + index), POSE, boxes, extras)


def assert_same(found: Boxes3D, expected: Boxes3D) -> None:
    for name in vars(expected):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


def test_what_is_written_is_read_back_exactly(tmp_path: Path) -> None:
    path = tmp_path / "predictions.json"
    with BoxesWriter(path, "world", {"model": "tiny", "untrained": True}, ego_from_bev=POSE) as writer:
        writer.write(frame(3, some_boxes(), sample_token="t3"))
        writer.write(frame(4, Boxes3D.empty(), skipped=True))
    found = read_boxes(path)
    assert found.frame_of_reference == "world"
    assert found.extras == {"model": "tiny", "untrained": True}
    assert found.ego_from_bev is not None
    np.testing.assert_array_equal(found.ego_from_bev.matrix, POSE.matrix)
    assert [f.stamp for f in found.frames] == [frame(3, Boxes3D.empty()).stamp, frame(4, Boxes3D.empty()).stamp]
    assert [dict(f.extras) for f in found.frames] == [{"sample_token": "t3"}, {"skipped": True}]
    assert found.frames[0].world_from_ego is not None
    np.testing.assert_array_equal(found.frames[0].world_from_ego.quaternion, POSE.quaternion)
    assert_same(found.frames[0].boxes, some_boxes())
    assert len(found.frames[1].boxes) == 0


def test_a_number_that_is_not_finite_is_refused_file_stays_whole(tmp_path: Path) -> None:
    path = tmp_path / "predictions.json"
    broken = some_boxes().transformed(np.full((4, 4), np.nan))
    with BoxesWriter(path, "world") as writer:
        writer.write(frame(0, some_boxes()))
        with pytest.raises(OutputError, match="frame 1: a box or pose has a number that is not finite"):
            writer.write(frame(1, broken))
    assert len(read_boxes(path).frames) == 1


@pytest.mark.parametrize("frames", [0, 1, 2])
@pytest.mark.parametrize("cut", [0, 1, 2, 20])
def test_a_writer_that_was_killed_leaves_its_finished_frames(tmp_path: Path, frames: int, cut: int) -> None:
    writer = BoxesWriter(tmp_path / "predictions.json", "world", {"model": "tiny"})
    for index in range(frames):
        writer.write(frame(index, some_boxes()))
    size = writer.size
    writer.write(frame(frames, some_boxes()))
    partial = tmp_path / "predictions.json.partial"
    os.truncate(partial, size + cut)  # the kernel had taken so many bytes of the last frame
    for path in (tmp_path / "predictions.json", partial):
        assert [f.stamp.index for f in read_boxes(path).frames] == list(range(frames))


def test_a_resumed_file_equals_one_that_was_written_at_once(tmp_path: Path) -> None:
    with BoxesWriter(tmp_path / "whole.json", "world") as writer:
        for index in range(3):
            writer.write(frame(index, some_boxes()))
    for first in range(3):  # the frames before the end; one more frame was written and is written again
        path = tmp_path / f"resumed-{first}.json"
        with BoxesWriter(path, "world") as writer:
            for index in range(first):
                writer.write(frame(index, some_boxes()))
            size = writer.size
            writer.write(frame(first, some_boxes()))
        with BoxesWriter(path, "world", resume_at=size) as writer:
            for index in range(first, 3):
                writer.write(frame(index, some_boxes()))
        assert path.read_bytes() == (tmp_path / "whole.json").read_bytes()


def good_file() -> dict[str, Any]:
    box = {"class": "car", "center": [1, 2, 3], "size_lwh": [4, 2, 1.5], "yaw": 0}
    row = {
        "frame": 5,
        "timestamp_ns": 1,
        "world_from_ego": {"translation": [0, 0, 0], "rotation": np.eye(3).tolist()},
        "boxes": [dict(box), dict(box)],
    }
    return {"format": "bevcli-boxes/1", "frame_of_reference": "world", "frames": [row]}


def test_only_the_necessary_keys_are_needed(tmp_path: Path) -> None:
    path = tmp_path / "boxes.json"
    path.write_text(json.dumps(good_file()))
    boxes = read_boxes(path).frames[0].boxes
    assert len(boxes) == 2
    assert np.isnan(boxes.velocities).all()
    assert boxes.scores is None
    assert boxes.num_points is None


def in_box(key: str, value: Any) -> Any:
    def plant(content: dict[str, Any]) -> None:
        content["frames"][0]["boxes"][1][key] = value

    return plant


def in_frame(key: str, value: Any) -> Any:
    def plant(content: dict[str, Any]) -> None:
        content["frames"][0][key] = value

    return plant


def repeat_the_frame(content: dict[str, Any]) -> None:
    content["frames"].append(content["frames"][0])


MISTAKES = {
    "class is a list": (in_box("class", []), r"frame 5: boxes\[1\].class: expected `str`, got `array`"),
    "class is empty": (in_box("class", ""), r"frame 5: boxes\[1\].class: expected `str` of length >= 1"),
    "unknown key": (in_box("heading", 1), r"frame 5: boxes\[1\]: object contains unknown field `heading`"),
    "two numbers": (in_box("center", [1, 2]), r"frame 5: boxes\[1\].center: expected `array` of length 3, got 2"),
    "a text": (in_box("center", [1, 2, "3"]), r"frame 5: boxes\[1\].center\[2\]: expected `float`, got `str`"),
    "a null": (in_box("center", [1, 2, None]), r"frame 5: boxes\[1\].center\[2\]: expected `float`, got `null`"),
    "NaN centre": (in_box("center", [1, 2, float("nan")]), "frame 5: box 1: center: expected finite"),
    "infinite yaw": (in_box("yaw", float("inf")), "frame 5: box 1: yaw: expected finite"),
    "yaw is a list": (in_box("yaw", [0.0]), r"frame 5: boxes\[1\].yaw: expected `float`, got `array`"),
    "flat box": (in_box("size_lwh", [4, 0, 1]), "frame 5: box 1: size_lwh: expected numbers above 0"),
    "one speed": (in_box("velocity", [1]), r"frame 5: boxes\[1\].velocity: expected `array` of length 2, got 1"),
    "score of one box": (in_box("score", 0.5), 'frame 5: box 0: "score" is missing'),
    "visibility in percent": (in_box("visibility", 40), "frame 5: box 1: visibility: expected 0 to 1"),
    "half a point": (in_box("num_points", 0.5), r"frame 5: boxes\[1\].num_points: expected `int`, got `float`"),
    "attribute": (in_box("attribute", 3), r"frame 5: boxes\[1\].attribute: expected `str \| null`, got `int`"),
    "time is a float": (in_frame("timestamp_ns", 1.5), "entry 0 of frames: timestamp_ns: expected `int`, got `float`"),
    "no pose": (in_frame("world_from_ego", None), 'frame 5: "world_from_ego" is missing'),
    "norm": (
        in_frame("world_from_ego", {"translation": [0, 0, 0], "rotation_wxyz": [1, 1, 0, 0]}),
        r'frame 5: "world_from_ego.rotation_wxyz" is not a rotation: its norm is not 1 \(expected .*, found 1.41421\)',
    ),
    "boxes no list": (in_frame("boxes", {}), "frame 5: boxes: expected `array`, got `object`"),
    "twice": (repeat_the_frame, 'frame 5: scene "" has two frames at 1 ns'),
    "format": (lambda content: content.update(format="coco"), "not a boxes file"),
    "frame of reference": (lambda c: c.update(frame_of_reference="lidar"), "must be world, ego or bev, found 'lidar'"),
    "no frames": (lambda content: content.pop("frames"), '"frames" is missing'),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_named_in_one_line(tmp_path: Path, name: str) -> None:
    plant, message = MISTAKES[name]
    content = good_file()
    plant(content)
    path = tmp_path / "boxes.json"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=message) as caught:
        read_boxes(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("text", ["{", "[]", '"boxes"', "\xff"])
def test_a_file_that_is_no_boxes_file(tmp_path: Path, text: str) -> None:
    path = tmp_path / "boxes.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"boxes\.json: "):
        read_boxes(path)
    with pytest.raises(InputError, match="is missing"):
        read_boxes(tmp_path / "other.json")


TRUTH = random_truth(11, frames=4)
PREDICTIONS = as_predictions(TRUTH, 12, noise_m=0.5, false_per_frame=10)
POSES = [Pose.from_matrix(rigid((500 + 10 * k, -20.0, 1.0), rotation_about_z(0.4 * k))) for k in range(4)]


def boxes_file(frames: list[Boxes3D], reference: str = "ego", **stamps: Any) -> BoxesFile:
    """A file of boxes given in the ego frame, in another frame of reference.

    stamps: scene, first (frame index), start_ns, poses.
    """
    bev = Pose.from_matrix(default_ego_from_bev())
    rows = []
    for place, boxes in enumerate(frames):
        from_ego = {"ego": np.eye(4), "world": POSES[place].matrix, "bev": inverse(default_ego_from_bev())}[reference]
        stamp = FrameStamp(
            stamps.get("first", 0) + place, stamps.get("scene", "a"), stamps.get("start_ns", 0) + 500_000_000 * place
        )
        pose = POSES[place] if stamps.get("poses", reference == "world") else None
        rows.append(FrameBoxes(stamp, pose, boxes.transformed(from_ego)))
    return BoxesFile(reference, tuple(rows), bev if reference == "bev" else None)


def nds(pairs: FramePairs) -> float:
    found, true = ([frame.boxes for frame in side] for side in (pairs.predictions, pairs.ground_truth))
    return evaluate_detections(found, true, None, pairs.ego_xy).overall.nd_score


@pytest.mark.parametrize("one", ["world", "ego", "bev"])
@pytest.mark.parametrize("other", ["world", "ego", "bev"])
def test_the_frame_of_reference_does_not_matter(one: str, other: str) -> None:
    expected = nds(pair_frames(boxes_file(PREDICTIONS), boxes_file(TRUTH)))
    pairs = pair_frames(boxes_file(PREDICTIONS, one), boxes_file(TRUTH, other))
    assert nds(pairs) == pytest.approx(expected)
    assert pairs.ego_pose_known == ("world" in (one, other))


def test_boxes_without_a_pose_to_transform_by_are_an_error() -> None:
    world = boxes_file(TRUTH, "world")
    bev = replace(boxes_file(PREDICTIONS, "bev"), ego_from_bev=None)
    with pytest.raises(InputError, match=r'frame 0: boxes in the bev frame .* add "ego_from_bev"'):
        pair_frames(bev, world)


@pytest.mark.parametrize(
    ("stamps", "matched_by"),
    [
        ({}, "scene and timestamp_ns"),
        ({"first": 7}, "scene and timestamp_ns"),
        ({"scene": "b"}, "timestamp_ns"),
        ({"start_ns": 1}, "scene and frame index"),
        ({"start_ns": 1, "scene": "b"}, "frame index"),
    ],
)
def test_the_key_that_frames_are_matched_by(stamps: dict[str, Any], matched_by: str) -> None:
    pairs = pair_frames(boxes_file(PREDICTIONS, **stamps), boxes_file(TRUTH))
    assert pairs.matched_by == matched_by
    assert len(pairs.predictions) == 4
    assert len(pairs.notes) == (0 if matched_by == "scene and timestamp_ns" else 1)


def test_sample_tokens_go_first() -> None:
    def with_tokens(file: BoxesFile, order: list[int]) -> BoxesFile:
        rows = [replace(frame, extras={"sample_token": f"t{k}"}) for frame, k in zip(file.frames, order, strict=True)]
        return replace(file, frames=tuple(rows))

    mixed = [PREDICTIONS[place] for place in (2, 0, 3, 1)]
    pairs = pair_frames(with_tokens(boxes_file(mixed), [2, 0, 3, 1]), with_tokens(boxes_file(TRUTH), [0, 1, 2, 3]))
    assert pairs.matched_by == "sample_token"
    assert nds(pairs) == pytest.approx(nds(pair_frames(boxes_file(PREDICTIONS), boxes_file(TRUTH))))


def test_frames_of_one_side_are_left_out_or_counted_with_a_note() -> None:
    half = boxes_file(PREDICTIONS[:2])
    left_out = pair_frames(half, boxes_file(TRUTH))
    assert len(left_out.predictions) == 2
    found = "2 of 4 ground-truth frames have no prediction: left out"
    assert left_out.notes == (f"{found} (`count_missing=True` (`--count-missing`) counts them)",)
    counted = pair_frames(half, boxes_file(TRUTH), count_missing=True)
    assert [len(frame.boxes) for frame in counted.predictions[2:]] == [0, 0]
    assert "count as missed" in counted.notes[0]
    more = pair_frames(boxes_file(PREDICTIONS), boxes_file(TRUTH[:1]))
    assert more.notes == ("3 of 4 predicted frames have no ground truth: left out",)


def test_files_of_different_drives_are_refused() -> None:
    other = boxes_file(TRUTH, scene="b", first=100, start_ns=10**18)
    with pytest.raises(InputError, match='no frame in common: predictions start with scene "a" frame 0 at 0 ns'):
        pair_frames(boxes_file(PREDICTIONS), other)
    with pytest.raises(InputError, match="the predictions contain no frame"):
        pair_frames(BoxesFile("ego", ()), boxes_file(TRUTH))
