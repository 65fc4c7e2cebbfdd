"""Ground truth from files of labelling tools: a CSV table as spreadsheets write it, and OpenLABEL."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from memory_drive import MemorySequence
from typer.testing import CliRunner

from bevcli.cli.main import app
from bevcli.errors import InputError
from bevcli.evaluation.export import write_csv, write_kitti
from bevcli.evaluation.formats.openlabel import openlabel
from bevcli.frame import Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes, read_boxes, write_boxes
from bevcli.sequences.labels import csv_table, kitti, label_format, openlabel as openlabel_reader
from bevcli.sequences.labels.sequence import WithLabels
from bevcli.sequences.native.writer import NativeWriter
from bevcli.sequences.options import LabelOptions

FORMATS = {"csv": csv_table.FORMAT, "kitti": kitti.FORMAT, "openlabel": openlabel_reader.FORMAT}
HEAD = "frame,class,x,y,z,length,width,height,yaw"


class Drive(MemorySequence):
    """Four frames on a curve, without ground truth."""

    def load(self, place: int) -> Frame:
        return replace(super().load(place), ground_truth=None)


@pytest.fixture(autouse=True)
def formats(monkeypatch: pytest.MonkeyPatch) -> None:
    """The formats of bevcli, whether or not its entry points are installed anew."""
    monkeypatch.setattr(label_format, "entries", lambda group: FORMATS)
    monkeypatch.setattr(label_format, "load", lambda group, name: FORMATS[name])


def boxes_of_drive(drive: Drive) -> BoxesFile:
    """A parked Lorry and a PKW that drives along the x axis of the world with 4 m/s."""
    frames = []
    for place, stamp in enumerate(drive.stamps):
        boxes = Boxes3D(
            np.array([[5.0 + 2 * place, 1, 1], [20.0, -3, 1]]),
            np.array([[4.0, 2, 1.5], [8.0, 2.5, 3]]),
            np.array([0.0, 1.0]),
            np.array([[4.0, 0], [0.0, 0]]),
            np.array(["PKW", "Lorry"]),
            instances=np.array(["a", "b"]),
        )
        frames.append(FrameBoxes(stamp, drive.load(place).world_from_ego, boxes))
    return BoxesFile("world", tuple(frames))


def same_boxes(one: Boxes3D, other: Boxes3D) -> None:
    np.testing.assert_allclose(one.to_numpy(), other.to_numpy(), atol=1e-4)
    assert one.classes.tolist() == other.classes.tolist()


def as_spreadsheet(text: str) -> bytes:
    """The bytes that a German spreadsheet writes."""
    cells = [line.split(",") for line in text.splitlines()]
    return ("\ufeff" + "".join(";".join(row).replace(".", ",") + "\r\n" for row in cells)).encode()


@pytest.mark.parametrize("form", ["csv", "spreadsheet", "openlabel"])
def test_what_bevcli_exports_is_read_again(form: str, tmp_path: Path) -> None:
    drive, path = Drive(), tmp_path / f"labels.{'json' if form == 'openlabel' else 'csv'}"
    given = boxes_of_drive(drive)
    if form == "openlabel":
        path.write_text(json.dumps(openlabel(given)))
    else:
        write_csv(given, path)
    if form == "spreadsheet":
        path.write_bytes(as_spreadsheet(path.read_text()))
    labelled = WithLabels(drive, path)
    for place, frame in enumerate(given.frames):
        same_boxes(labelled.load(place).ground_truth, frame.boxes)
    assert labelled.class_counts == {"PKW": 4, "Lorry": 4}
    notes = " ".join(labelled.notes)
    said = ["byte order mark", "CRLF", "semicolons", "decimal commas"]
    assert [each in notes for each in said] == [form == "spreadsheet"] * 4


def test_tracks_give_velocities_over_ground(tmp_path: Path) -> None:
    drive, path = Drive(), tmp_path / "labels.csv"
    rows = [f"{HEAD},instance"]
    for place, frame in enumerate(boxes_of_drive(drive).frames):
        in_ego = frame.boxes.transformed(np.linalg.inv(frame.world_from_ego.matrix))
        for box, name in enumerate(in_ego.classes):
            numbers = (*in_ego.centers[box], *in_ego.sizes_lwh[box], in_ego.yaws[box])
            rows.append(",".join([str(place), name, *map(repr, map(float, numbers)), f"track {box}"]))
    path.write_text("\n".join(rows))
    labelled = WithLabels(drive, path)
    np.testing.assert_allclose(labelled.load(1).ground_truth.velocities, [[4, 0], [0, 0]], atol=1e-6)
    assert any('are taken to be in the "ego" frame' in note for note in labelled.notes)


def test_frames_without_a_row_are_empty_or_left_out(tmp_path: Path) -> None:
    drive, path = Drive(), tmp_path / "labels.csv"
    path.write_text(f"{HEAD}\n{drive.stamps[1].index},PKW,1,2,0,4,2,1,0\n")
    assert [len(WithLabels(drive, path).load(place).ground_truth) for place in range(3)] == [0, 1, 0]
    labelled = WithLabels(drive, path, LabelOptions(only_labelled=True))
    assert [labelled.load(place).ground_truth is None for place in range(3)] == [True, False, True]
    assert any("1 frames with boxes: PKW (1); 3 frames without boxes have no" in note for note in labelled.notes)
    assert any("a column `instance` would give them" in note for note in labelled.notes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"column class is missing .*found none"),
        ("frame,class,x\n", "column y is missing"),
        (HEAD.replace("frame,", ""), "column frame or timestamp_ns is missing"),
        (f"{HEAD}\n0,PKW,1,2,0,4,2,0,0", r'line 2: column height: expected a number above 0, found "0"'),
        (f"{HEAD}\n0,PKW,1,2,0,4,2,1,x", r'line 2: column yaw: expected a number, found "x"'),
        (f"{HEAD}\n0,PKW,nan,2,0,4,2,1,1", r'line 2: column x: expected a number, found "nan"'),
        (f"{HEAD}\n0.5,PKW,1,2,0,4,2,1,1", "line 2: column frame: expected an integer"),
        (f"{HEAD}\n0,,1,2,0,4,2,1,1", "line 2: column class is empty"),
        (f"{HEAD}\n0,PKW", r'line 2: column x: expected a number, found ""'),
        (f"{HEAD}\n999,PKW,1,2,0,4,2,1,1", "the frame 999 is not in the drive .*are these the labels of this drive"),
        (f"{HEAD},frame_of_reference\n0,PKW,1,2,0,4,2,1,1,lidar", "frame_of_reference: expected world, ego or bev"),
        (f"{HEAD}\n0,PKW,1,5,2,0,4,2,1,1", "line 2: has more cells than the 9 columns"),
        (f"{HEAD},x\n", "two columns have one name"),
    ],
)
def test_a_wrong_table_is_one_clear_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "labels.csv").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        WithLabels(Drive(), tmp_path / "labels.csv")
    assert "\n" not in str(caught.value)


def openlabel_text(cuboid: dict, timestamp: object = None) -> str:
    properties = {} if timestamp is None else {"timestamp": timestamp}
    frame = {"frame_properties": properties, "objects": {"7": {"object_data": {"cuboid": [cuboid]}}}}
    return json.dumps({"openlabel": {"objects": {"7": {"name": "a", "type": "PKW"}}, "frames": {"0": frame}}})


def test_openlabel_angles_turn_about_the_vertical(tmp_path: Path) -> None:
    path = tmp_path / "labels.json"
    path.write_text(openlabel_text({"name": "a", "val": [1, 2, 3, 0, 0, 0.7, 4, 2, 1], "coordinate_system": "ego"}))
    (frame,) = label_format.read_labels(path, Drive().rig, LabelOptions()).frames
    np.testing.assert_allclose(frame.boxes.yaws, [0.7])
    assert (frame.boxes.classes.tolist(), frame.boxes.instances.tolist()) == (["PKW"], ["7"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "is not OpenLABEL"),
        ("{", "is not OpenLABEL"),
        (openlabel_text({"val": [1, 2]}), "object 7: expected a cuboid of 10 or 9 numbers"),
        (openlabel_text({"val": [0] * 10}), "sizes above 0"),
        (openlabel_text({"val": [1] * 9, "coordinate_system": "lidar"}), "in one of world, odom, ego, .* found lidar"),
        (openlabel_text({"val": [1] * 9}, "yesterday"), 'timestamp "yesterday" is not a time'),
    ],
)
def test_wrong_openlabel_is_one_clear_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "labels.json").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        WithLabels(Drive(), tmp_path / "labels.json")
    assert "\n" not in str(caught.value)


def test_kitti_labels_that_bevcli_exports_are_read_again(tmp_path: Path) -> None:
    drive = Drive()
    given = boxes_of_drive(drive)
    camera = drive.rig["CAM_FRONT"]
    write_kitti(given, camera, drive.rig.ego_from_bev, tmp_path / "kitti")
    labelled = WithLabels(drive, tmp_path / "kitti/label_2")
    for place in range(2):  # later, the camera does not see both
        found, frame = labelled.load(place).ground_truth, given.frames[place]
        np.testing.assert_allclose(found.centers, frame.boxes.centers, atol=2e-3)
        np.testing.assert_allclose(found.yaws, frame.boxes.yaws, atol=2e-3)
        np.testing.assert_allclose(found.sizes_lwh, frame.boxes.sizes_lwh, atol=1e-3)


def test_a_kitti_tracking_file_has_tracks(tmp_path: Path) -> None:
    path = tmp_path / "0000.txt"
    line = "Car 0 0 0 0 0 9 9 1.5 2 4 {} 1 20 0"
    others = ["1 -1 DontCare -1 -1 -10 1 1 9 9 -1 -1 -1 -1000 -1000 -1000 -10", ""]
    path.write_text("\n".join([*(f"{frame} 3 {line.format(0)}" for frame in range(3)), *others]))
    labelled = WithLabels(Drive(), path)
    assert [labelled.load(place).ground_truth.instances.tolist() for place in range(3)] == [["3"]] * 3
    assert np.isfinite(labelled.load(1).ground_truth.velocities).all()
    assert any("those that CAM_FRONT sees" in note for note in labelled.notes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x 1 Car", "line 1: expected the index of a frame and a track"),
        ("0 1 Car 0 0", "line 1: expected 15 or 16 words from the type on"),
        ("0 1 Car 0 0 0 0 0 9 9 0 2 4 0 1 20 0", "sizes above 0"),
        ("0 1 Car 0 0 0 0 0 9 9 1 2 4 nan 1 20 0", "finite numbers"),
    ],
)
def test_wrong_kitti_labels_are_one_clear_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "0000.txt").write_text(text)
    with pytest.raises(InputError, match=message):
        WithLabels(Drive(), tmp_path / "0000.txt")
    with pytest.raises(InputError, match="`labels_camera=roof`: is not in the rig"):
        WithLabels(Drive(), tmp_path / "0000.txt", LabelOptions(labels_camera="roof"))


def test_labels_of_another_kind_are_refused(tmp_path: Path) -> None:
    (tmp_path / "labels.xml").write_text("")
    with pytest.raises(InputError, match=r"is no file of labels \(expected a CSV table .* or an OpenLABEL file"):
        WithLabels(Drive(), tmp_path / "labels.xml")


def test_convert_writes_the_labels_as_ground_truth(tmp_path: Path) -> None:
    drive = Drive()
    with NativeWriter(tmp_path / "drive", with_ego_motion=True) as writer:
        for place in range(len(drive.stamps)):
            writer.write(drive.load(place))
    write_boxes(boxes_of_drive(drive), tmp_path / "truth.json")
    write_csv(boxes_of_drive(drive), tmp_path / "labels.csv")
    command = ["convert", str(tmp_path / "drive"), str(tmp_path / "out"), "--labels", str(tmp_path / "labels.csv")]
    answer = CliRunner().invoke(app, command, catch_exceptions=False)
    assert answer.exit_code == 0
    assert "PKW (4)" in answer.stderr
    found, given = read_boxes(tmp_path / "out/ground_truth.json"), read_boxes(tmp_path / "truth.json")
    for one, other in zip(found.frames, given.frames, strict=True):
        same_boxes(one.boxes, other.boxes)
