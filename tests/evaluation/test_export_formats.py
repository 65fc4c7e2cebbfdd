"""Exports contain the boxes of the file; KITTI labels are read back with the formulas of KITTI's development kit."""

import csv
import resource
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import invoked
from made_boxes import made_boxes

from bevcli.errors import InputError, OutputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera, default_ego_from_bev
from bevcli.geometry.transforms import Pose, rigid, rotation_about_z
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes, read_boxes, write_boxes
from bevcli.sequences.files.boxes_table import write_csv
from bevcli.workshop.formats.kitti import kitti_labels, write_kitti
from bevcli.workshop.formats.nuscenes_output import write_submission

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
    path, before = tmp_path / "boxes.txt", resource.getrlimit(resource.RLIMIT_FSIZE)
    path.write_text("old")
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(OutputError, match=r"/boxes\.txt: cannot be written"):
            write(boxes, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_an_unknown_format_names_the_known_ones() -> None:
    sample = Path(__file__).parents[2] / "samples/street/ground_truth.json"
    with pytest.raises(InputError, match=r"`form=dxf` \(`--format`\): unknown format \(expected csv, json, kitti, "):
        invoked("export", sample, "--format", "dxf")
