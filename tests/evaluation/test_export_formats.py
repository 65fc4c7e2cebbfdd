"""Exports hold the boxes of the file; KITTI labels and submissions follow the rules of their kits, restated here."""

import csv
import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import full_disk, invoked
from made_boxes import made_boxes

from bevcli.errors import InputError, OutputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D, attributes_by_speed
from bevcli.geometry.cameras import Camera, default_ego_from_bev
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.geometry.transforms import Pose, rigid, rotation_about_z, yaw_of_quaternion
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes, read_boxes
from bevcli.sequences.files.boxes_table import write_csv
from bevcli.workshop.formats.convert import write_boxes
from bevcli.workshop.formats.kitti import kitti_labels, write_kitti
from bevcli.workshop.formats.nuscenes_output import SubmissionWriter, is_submission, read_submission, write_submission

# Camera axes in the ego frame, as columns: x right, y down, z forward.
LOOKING_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
CAMERA = Camera(
    "CAM_FRONT",
    1600,
    900,
    np.array([[1200.0, 0, 800], [0, 1200.0, 450], [0, 0, 1]]),
    rigid((1.7, 0.1, 1.5), rotation_about_z(0.1) @ LOOKING_AHEAD),
)


def boxes_around() -> Boxes3D:
    rng = np.random.default_rng(3)
    count = 40
    return Boxes3D(
        centers=np.concatenate([rng.uniform(-40, 40, (count, 2)), rng.uniform(0.5, 1.5, (count, 1))], axis=1),
        sizes_lwh=rng.uniform(0.5, 5, (count, 3)),
        yaws=rng.uniform(-3, 3, count),
        velocities=np.zeros((count, 2)),
        classes=np.repeat(["car", "bicycle"], count // 2),
        scores=rng.uniform(0, 1, count),
    )


def file_of(boxes: Boxes3D, world_from_ego: Pose) -> BoxesFile:
    frame = FrameBoxes(FrameStamp(7, "s", 123), world_from_ego, boxes.transformed(world_from_ego.matrix))
    return BoxesFile("world", (frame,))


def kitti_corners(fields: list[str]) -> np.ndarray:
    """(8, 3) a label's corners in the camera's frame, by the formula of KITTI's development kit."""
    height, width, length, x, y, z, rotation_y = map(float, fields[8:15])
    turn = np.array(
        [
            [np.cos(rotation_y), 0, np.sin(rotation_y)],
            [0, 1, 0],
            [-np.sin(rotation_y), 0, np.cos(rotation_y)],
        ]
    )
    a, b = length / 2, width / 2
    corners = np.array(
        [
            [a, a, -a, -a, a, a, -a, -a],
            [0, 0, 0, 0, -height, -height, -height, -height],
            [b, -b, -b, b, b, -b, -b, b],
        ]
    )
    return (turn @ corners).T + (x, y, z)


def test_kitti_labels_are_the_boxes_in_the_cameras_frame() -> None:
    boxes = boxes_around()
    ahead = boxes[[int(place) for place in np.flatnonzero(boxes.centers[:, 0] > 10)]]
    labels = [line.split() for line in kitti_labels(ahead, CAMERA)]
    assert labels
    expected = [np.sort(ahead.corners()[k] @ CAMERA.camera_from_ego[:3, :3].T, axis=0) for k in range(len(ahead))]
    offset = CAMERA.camera_from_ego[:3, 3]
    for fields in labels:
        corners = np.sort(kitti_corners(fields) - offset, axis=0)
        assert min(np.abs(corners - wanted).max() for wanted in expected) < 5e-3
        assert fields[0] in ("Car", "Cyclist")
        assert len(fields) == 16


def test_every_box_in_view_has_a_label_with_its_2d_box() -> None:
    boxes = boxes_around()
    rotation, translation = cv2.Rodrigues(CAMERA.camera_from_ego[:3, :3])[0], CAMERA.camera_from_ego[:3, 3]
    labels = kitti_labels(boxes, CAMERA)
    for place in range(len(boxes)):
        own = kitti_labels(boxes[[place]], CAMERA)
        corners = boxes.corners()[place]
        depths = corners @ CAMERA.camera_from_ego[2, :3] + CAMERA.camera_from_ego[2, 3]
        if (depths < 0).all():
            assert own == []
        elif (depths > 1).all():
            pixels = cv2.projectPoints(corners, rotation, translation, CAMERA.intrinsics, None)[0][:, 0]
            low, high = np.clip(pixels.min(0), 0, (1599, 899)), np.clip(pixels.max(0), 0, (1599, 899))
            in_view = bool((high > low).all())
            assert bool(own) == in_view
            if in_view:
                found = np.array(own[0].split()[4:8], dtype=float)
                np.testing.assert_allclose(found, [*low, *high], atol=2e-3)
        assert all(line in labels for line in own)


def test_a_box_straight_ahead_by_hand() -> None:
    level = Camera("C", 1600, 900, CAMERA.intrinsics, rigid((0, 0, 1.5), LOOKING_AHEAD))
    fields = kitti_labels(made_boxes([(20.0, 2.0, 0.75)]), level)[0].split()
    # Driving away: heading along the camera's z, which is rotation_y -90 degrees; 2 m to the left, on the ground.
    assert [float(value) for value in fields[8:]] == pytest.approx([1.5, 2, 4, -2, 1.5, 20, -np.pi / 2], abs=1e-3)
    assert float(fields[3]) == pytest.approx(-np.pi / 2 + np.arctan(0.1), abs=1e-3)


def test_kitti_files_do_not_depend_on_the_world(tmp_path: Path) -> None:
    pose = Pose.from_matrix(rigid((500.0, 30.0, 2.0), rotation_about_z(2.0)))
    for name, world_from_ego in (("here", Pose.identity()), ("there", pose)):
        write_kitti(file_of(boxes_around(), world_from_ego), CAMERA, default_ego_from_bev(), tmp_path / name)
    here, there = ((tmp_path / name / "label_2" / "000007.txt").read_text() for name in ("here", "there"))
    for one, other in zip(here.splitlines(), there.splitlines(), strict=True):
        assert [float(v) for v in one.split()[1:]] == pytest.approx([float(v) for v in other.split()[1:]], abs=2e-3)
    calibration = (tmp_path / "here" / "calib" / "000007.txt").read_text()
    rows = {line.split(":")[0]: np.array(line.split()[1:], dtype=float) for line in calibration.splitlines()}
    np.testing.assert_allclose(rows["P2"].reshape(3, 4)[:, :3], CAMERA.intrinsics)
    velo = np.vstack([rows["Tr_velo_to_cam"].reshape(3, 4), [0, 0, 0, 1]])
    np.testing.assert_allclose(CAMERA.ego_from_camera @ velo, default_ego_from_bev(), atol=1e-9)


def test_kitti_refuses_repeated_frame_indices(tmp_path: Path) -> None:
    file = file_of(boxes_around(), Pose.identity())
    with pytest.raises(InputError, match="frame indices repeat"):
        write_kitti(BoxesFile("world", file.frames * 2), CAMERA, default_ego_from_bev(), tmp_path)


def test_csv_has_a_row_a_box(tmp_path: Path) -> None:
    boxes = boxes_around()
    assert write_csv(file_of(boxes, Pose.identity()), tmp_path / "boxes.csv") == len(boxes)
    rows = list(csv.DictReader((tmp_path / "boxes.csv").open()))
    assert len(rows) == len(boxes)
    np.testing.assert_allclose([[float(row[k]) for k in "xyz"] for row in rows], boxes.centers)
    np.testing.assert_allclose(
        [[float(row[k]) for k in ("length", "width", "height")] for row in rows], boxes.sizes_lwh
    )
    assert rows[0]["frame"] == "7"
    assert rows[0]["frame_of_reference"] == "world"
    assert rows[0]["attribute"] == ""


def test_the_command_does_not_replace_its_input(tmp_path: Path) -> None:
    path = tmp_path / "boxes.json"
    shutil.copy(Path(__file__).parents[2] / "samples/street/ground_truth.json", path)
    before = path.read_bytes()
    with pytest.raises(OutputError):
        invoked("export", path, "--format", "csv", "--out", path)
    assert path.read_bytes() == before


def test_kitti_takes_the_calibration_next_to_the_boxes(tmp_path: Path) -> None:
    sample = Path(__file__).parents[2] / "samples/street"
    shutil.copy(sample / "ground_truth.json", tmp_path)
    arguments = ["export", tmp_path / "ground_truth.json", "--format", "kitti"]
    with pytest.raises(InputError, match=f"there is no {tmp_path / 'calibration.json'}"):
        invoked(*arguments)
    shutil.copy(sample / "calibration.json", tmp_path)
    for chosen in ([], ["--calibration", sample, "--out", tmp_path / "stated"]):
        invoked(*arguments, *chosen)
    names = sorted(path.relative_to(tmp_path / "kitti") for path in (tmp_path / "kitti").rglob("*.txt"))
    assert len(names) == 40  # labels and calibrations of 20 frames
    assert all((tmp_path / "kitti" / name).read_text() == (tmp_path / "stated" / name).read_text() for name in names)


def submitted(frame: FrameBoxes) -> FrameBoxes:
    boxes = replace(frame.boxes, scores=np.ones(len(frame.boxes)))
    return replace(frame, boxes=boxes, extras={"sample_token": str(frame.stamp.index)})


@pytest.mark.parametrize("write", [write_csv, write_boxes, write_submission])
def test_a_file_that_does_not_fit_leaves_the_old_one(tmp_path: Path, write: Callable[..., int]) -> None:
    boxes = read_boxes(Path(__file__).parents[2] / "samples/street/ground_truth.json")
    boxes = replace(boxes, frames=tuple(map(submitted, boxes.frames)))
    path = tmp_path / "boxes.txt"
    path.write_text("old")
    with full_disk(1000), pytest.raises(OutputError, match=r"/boxes\.txt: cannot be written"):
        write(boxes, path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_an_unknown_format_names_the_known_ones() -> None:
    sample = Path(__file__).parents[2] / "samples/street/ground_truth.json"
    with pytest.raises(InputError, match=r"`form=dxf` \(`--format`\): unknown format \(expected csv, json, kitti, "):
        invoked("export", sample, "--format", "dxf")


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
