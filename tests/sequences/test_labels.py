"""Ground truth from files of labelling tools, and with class names of other data sets."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import invoked
from memory_drive import MemoryDrive

from bevcli.errors import InputError
from bevcli.frame import Drive, Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes, read_boxes
from bevcli.sequences.files.boxes_table import write_csv
from bevcli.sequences.open import DriveView, open_sequence
from bevcli.workshop.formats import LabelOptions, UnlistedFrames
from bevcli.workshop.formats.kitti import write_kitti
from bevcli.workshop.formats.labels import WithLabels, _labelled_frames
from bevcli.workshop.formats.output import NativeWriter

HEAD = "frame,class,x,y,z,length,width,height,yaw"
DOCUMENTED = LabelOptions(
    labels_frame="ego", labels_sides="lwh", labels_yaw="x", labels_yaw_unit="radians", labels_z="center"
)


class MadeDrive(MemoryDrive):
    """Four frames on a curve, without ground truth."""

    def load(self, index: int) -> Frame:
        return replace(super().load(index), ground_truth=None)


def boxes_of_drive(drive: MadeDrive) -> BoxesFile:
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


@pytest.mark.parametrize("form", ["csv", "spreadsheet"])
def test_what_bevcli_exports_is_read_again(form: str, tmp_path: Path) -> None:
    drive, path = MadeDrive(), tmp_path / "labels.csv"
    given = boxes_of_drive(drive)
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
    drive, path = MadeDrive(), tmp_path / "labels.csv"
    rows = [f"{HEAD},instance"]
    for place, frame in enumerate(boxes_of_drive(drive).frames):
        in_ego = frame.boxes.transformed(np.linalg.inv(frame.world_from_ego.matrix))
        for box, name in enumerate(in_ego.classes):
            numbers = (*in_ego.centers[box], *in_ego.sizes_lwh[box], in_ego.yaws[box])
            rows.append(",".join([str(place), name, *map(repr, map(float, numbers)), f"track {box}"]))
    path.write_text("\n".join(rows))
    labelled = WithLabels(drive, path, DOCUMENTED)
    np.testing.assert_allclose(labelled.load(1).ground_truth.velocities, [[4, 0], [0, 0]], atol=1e-6)


@pytest.mark.parametrize(
    ("listed", "unlisted", "expected", "note"),
    [
        ((0, 1), None, "1100", "2 frames with labels: PKW (2); 2 frames without rows are empty"),
        ((0, 2), None, "1x1x", "2 frames with labels: PKW (2); 2 frames are not labelled"),  # at half the rate
        ((1,), None, "x1xx", "1 frame with labels: PKW (1); 3 frames are not labelled"),
        ((0, 2), "empty", "1010", "2 frames without rows are empty (see `unlisted_frames` (`--unlisted-frames`))"),
        ((0, 1), "unlabelled", "11xx", "2 frames are not labelled: they have no ground truth"),
        ((), None, "xxxx", "0 frames with labels: none; 4 frames are not labelled"),
    ],
)
def test_frames_without_a_row_are_empty_or_unlabelled(
    listed: tuple[int, ...], unlisted: UnlistedFrames | None, expected: str, note: str, tmp_path: Path
) -> None:
    drive, path = MadeDrive(), tmp_path / "labels.csv"
    path.write_text("\n".join([HEAD, *(f"{drive.stamps[place].index},PKW,1,2,0,4,2,1,0" for place in listed)]))
    labelled = WithLabels(drive, path, replace(DOCUMENTED, unlisted_frames=unlisted))
    truths = [labelled.load(place).ground_truth for place in range(4)]
    assert "".join("x" if truth is None else str(len(truth)) for truth in truths) == expected
    assert any(note in each for each in labelled.notes)
    assert any("a column `instance` would give them" in each for each in labelled.notes) == bool(listed)
    # Of a longer drive of two scenes, also where the labels have a lower rate.
    stamps = tuple(replace(drive.stamps[0], index=index, scene="ab"[index // 12]) for index in range(24))
    assert sorted(_labelled_frames(stamps, {3, 9, 18}, None)) == [3, 9, 18]
    assert sorted(_labelled_frames(stamps, {1, 4, 10}, None)) == [1, 4, 7, 10]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"column class is missing .*found none"),
        ("frame,class,x\n", "column y is missing"),
        (HEAD.replace("frame,", ""), "column frame or timestamp_ns is missing"),
        (f"{HEAD}\n0,PKW,1,2,0,4,2,1,x", r'line 2, column yaw: expected a number, found "x"'),
        (f"{HEAD}\n0,PKW,nan,2,0,4,2,1,1", r'line 2, column x: expected a finite number, found "nan"'),
        (f"{HEAD}\n0.5,PKW,1,2,0,4,2,1,1", "line 2, column frame: expected an integer"),
        (f"{HEAD}\n0,,1,2,0,4,2,1,1", "line 2, column class: is empty"),
        (f"{HEAD}\n0,PKW", r'line 2, column x: expected a number, found ""'),
        (f"{HEAD}\n999,PKW,1,2,0,4,2,1,1", "the frame 999 is not in the drive .*are these the labels of this drive"),
        (f"{HEAD},frame_of_reference\n0,PKW,1,2,0,4,2,1,1,lidar", "frame_of_reference: expected world, ego or bev"),
        (f"{HEAD}\n0,PKW,1,5,2,0,4,2,1,1", "line 2: has more cells than the 9 columns"),
        (f"{HEAD},x\n", "two columns have one name"),
        (f"{HEAD}\n0,car,1e4,0,1e3,4500,1900,1500,0", r"of 4500 m, .* 4500 m \(in millimetres\?\): convert x, y, z"),
        (f"{HEAD}\n0,car,1e3,0,1e2,450,190,150,0", r"boxes of 450 m, the median is 450 m \(in centimetres"),
        (f"{HEAD}\n0,car,10,0,1,4.5,1.9,1.5,4000", r"a yaw of 4000 \(expected radians, or degrees up to 360"),
    ],
)
def test_a_wrong_table_is_one_clear_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "labels.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        WithLabels(MadeDrive(), tmp_path / "labels.csv")


def test_kitti_labels_that_bevcli_exports_are_read_again(tmp_path: Path) -> None:
    drive = MadeDrive(2)  # later, the camera does not see both
    given = boxes_of_drive(drive)
    camera = drive.rig["CAM_FRONT"]
    write_kitti(given, camera, drive.rig.ego_from_bev, tmp_path / "kitti")
    with pytest.raises(InputError, match=r"nor images tell which it is: pass `--labels-camera CAM_FRONT` or "):
        WithLabels(drive, tmp_path / "kitti/label_2")
    labelled = WithLabels(drive, tmp_path / "kitti/label_2", LabelOptions(labels_camera="CAM_FRONT"))
    for place in range(2):
        found, frame = labelled.load(place).ground_truth, given.frames[place]
        np.testing.assert_allclose(found.centers, frame.boxes.centers, atol=2e-3)
        np.testing.assert_allclose(found.yaws, frame.boxes.yaws, atol=2e-3)
        np.testing.assert_allclose(found.sizes_lwh, frame.boxes.sizes_lwh, atol=1e-3)
    assert any("velocities of the boxes are not known" in note for note in labelled.notes)  # without tracks


def test_a_kitti_tracking_file_has_tracks(tmp_path: Path) -> None:
    path = tmp_path / "0000.txt"
    line = "Car 0 0 0 0 0 9 9 1.5 2 4 {} 1 20 0"
    others = ["1 -1 DontCare -1 -1 -10 1 1 9 9 -1 -1 -1 -1000 -1000 -1000 -10", ""]
    path.write_text("\n".join([*(f"{frame} 3 {line.format(0)}" for frame in range(3)), *others]))
    labelled = WithLabels(MadeDrive(), path, LabelOptions(labels_camera="CAM_FRONT"))
    assert [labelled.load(place).ground_truth.instances.tolist() for place in range(3)] == [["3"]] * 3
    assert np.isfinite(labelled.load(1).ground_truth.velocities).all()
    assert any("those that CAM_FRONT sees" in note for note in labelled.notes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x 1 Car", "line 1: expected the index of a frame and a track"),
        ("0 1 Car 0 0", "line 1: expected 15 or 16 words from the type on"),
        ("0 1 Car 0 0 0 0 0 9 9 1 2 4 nan 1 20 0", "finite numbers"),
        ("0 1 Car 0 0 0 0 0 9 9 1 2 4 1 1 20 -90", "rotation_y is -90 .expected radians"),
    ],
)
def test_wrong_kitti_labels_are_one_clear_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "0000.txt").write_text(text)
    with pytest.raises(InputError, match=message):
        WithLabels(MadeDrive(), tmp_path / "0000.txt")
    (tmp_path / "labels.xml").write_text("")
    with pytest.raises(InputError, match=r"is no file of labels \(expected KITTI labels .* or a table \(.csv\) with"):
        WithLabels(MadeDrive(), tmp_path / "labels.xml")
    with pytest.raises(InputError, match=r"`labels_camera=roof` .*: is not in the rig"):
        WithLabels(MadeDrive(), tmp_path / "0000.txt", LabelOptions(labels_camera="roof"))


def test_convert_writes_the_labels_as_ground_truth(tmp_path: Path) -> None:
    drive = MadeDrive()
    with NativeWriter(tmp_path / "drive", with_ego_motion=True) as writer:
        for place in range(len(drive.stamps)):
            writer.write(drive.load(place))
    given = boxes_of_drive(drive)
    write_csv(given, tmp_path / "labels.csv")
    answer = invoked("convert", tmp_path / "drive", tmp_path / "out", "--labels", tmp_path / "labels.csv")
    assert "PKW (4)" in answer.stderr
    for one, other in zip(read_boxes(tmp_path / "out/ground_truth.json").frames, given.frames, strict=True):
        same_boxes(one.boxes, other.boxes)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("labels.csv", f"{HEAD}\n0,PKW,1,2,0,4,2,0,0\n0,PKW,1,2,0,4,2,1,0"),
        ("0000.txt", "0 1 Car 0 0 0 0 0 9 9 0 2 4 0 1 20 0\n0 2 Car 0 0 0 0 0 9 9 1 2 4 0 1 20 0"),
    ],
)
def test_a_box_of_size_0_is_left_out_of_labels(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    labelled = WithLabels(MadeDrive(), tmp_path / name, replace(DOCUMENTED, labels_camera="CAM_FRONT"))
    assert any("left out: a size of 0 or less" in note for note in labelled.notes)
    boxes = [labelled.load(place).ground_truth for place in range(4)]
    assert all((each.sizes_lwh > 0).all() for each in boxes if each is not None)
    assert len(labelled.load(0).ground_truth) == 1


def street_table(path: Path, drive: Drive, **held: str) -> None:
    """The ground truth of the sample drive as another program writes it."""
    turned = {"x": (1, 0), "clockwise": (-1, 0), "compass": (-1, np.pi / 2), "kitti": (-1, -np.pi / 2)}
    lidar_from_ego = np.eye(4)
    lidar_from_ego[:3, 3] = -0.9, 0.0, -1.8
    rows = [HEAD]
    for place, stamp in enumerate(drive.stamps):
        frame = drive.load(place)
        frames = {"world": np.eye(4), "ego": np.linalg.inv(frame.world_from_ego.matrix)}
        frames["bev"] = np.linalg.inv(frame.rig.ego_from_bev) @ frames["ego"]
        frames["lidar"] = lidar_from_ego @ frames["ego"]
        boxes = frame.ground_truth.transformed(frames[held.get("frame", "ego")])
        sign, offset = turned[held.get("yaw", "x")]
        for box in boxes:
            sides = dict(zip("lwh", box.size_lwh, strict=True))
            z = box.center[2] - (box.size_lwh[2] / 2 if "z" in held else 0)
            yaw = sign * (box.yaw - offset)
            yaw = np.degrees(yaw) % 360 if "degrees" in held else yaw
            numbers = (*box.center[:2], z, *(sides[side] for side in held.get("sides", "lwh")), yaw)
            rows.append(",".join([str(stamp.index), box.class_name, *map(repr, map(float, numbers))]))
    path.write_text("\n".join(rows))


@pytest.fixture(scope="module")
def street() -> Drive:
    return open_sequence(Path(__file__).parents[2] / "samples/street", every=2, frames=slice(0, 4))


@pytest.mark.parametrize(
    ("held", "note"),
    [
        ({}, 'taken to be in the "ego" frame'),
        ({"frame": "world", "sides": "wlh"}, "boxes in the world frame (the boxes: 0.0 m; boxes in the ego frame: "),
        ({"frame": "bev", "yaw": "kitti"}, "yaws clockwise from -y, as rotation_y of KITTI (the boxes: "),
        ({"degrees": "to 360"}, "the yaws, of up to 359, are taken to be in degrees"),
        ({"yaw": "compass", "sides": "hlw"}, "sides in the order height, length, width (the boxes: "),
        ({"z": "bottom", "yaw": "clockwise"}, "z of the bottom (the boxes: 0.0 m; z of the center: "),
    ],
)
def test_boxes_show_what_a_table_holds(held: dict[str, str], note: str, street: Drive, tmp_path: Path) -> None:
    street_table(tmp_path / "labels.csv", street, **held)
    found = WithLabels(street, tmp_path / "labels.csv")
    assert any(note in line for line in found.notes)
    for place in range(len(street.stamps)):
        one, other = found.load(place).ground_truth, street.load(place).ground_truth
        np.testing.assert_allclose(one.to_numpy()[:, :6], other.to_numpy()[:, :6], atol=1e-6)
        np.testing.assert_allclose(np.exp(1j * one.yaws), np.exp(1j * other.yaws), atol=1e-6)


def test_a_table_that_fits_nothing_is_read_as_stated(street: Drive, tmp_path: Path) -> None:
    path, few = tmp_path / "labels.csv", DriveView(street, [0, 1])
    street_table(path, few, frame="lidar")
    with pytest.raises(InputError, match=r"fit no reading .*--labels-frame ego --labels-z center` to read it"):
        WithLabels(few, path)
    found = WithLabels(few, path, LabelOptions(labels_frame="ego", labels_z="center"))
    assert any("what is stated does not fit the boxes" in note for note in found.notes)


def test_images_show_what_the_boxes_of_one_frame_do_not(street: Drive, tmp_path: Path) -> None:
    first, path = DriveView(street, [0]), tmp_path / "labels.csv"
    street_table(path, first, frame="bev", sides="wlh")
    head, *lines = path.read_text().splitlines()
    path.write_text("\n".join([head, *[line for line in lines if ",car," in line][:4]]))
    with pytest.raises(InputError, match=r"neither boxes nor images tell which it is: .*--labels-yaw"):
        WithLabels(first, path)
    found = WithLabels(first, path, LabelOptions(labels_sides="wlh", labels_yaw="x", labels_yaw_unit="radians"))
    assert any("boxes in the bev frame" in note and "(the images: overlap 0." in note for note in found.notes)
    truth = first.load(0).ground_truth
    truth = truth[truth.classes == "car"][:4]
    np.testing.assert_allclose(found.load(0).ground_truth.to_numpy()[:, :7], truth.to_numpy()[:, :7], atol=1e-6)


@pytest.mark.slow
def test_images_show_of_which_camera_kitti_labels_are(street: Drive, tmp_path: Path) -> None:
    few = DriveView(street, [0, 3])
    frames = tuple(FrameBoxes(few.stamps[place], few.load(place).world_from_ego, few.load(place).ground_truth)
                   for place in range(2))  # fmt: skip
    write_kitti(BoxesFile("world", frames), few.rig["CAM_FRONT_LEFT"], few.rig.ego_from_bev, tmp_path)
    found = WithLabels(few, tmp_path / "label_2")
    assert any("boxes in the frame of CAM_FRONT_LEFT (the images: overlap" in note for note in found.notes)


CLASSES = ("Car", "TRUCK", "Tricycle", "lorry", "pedestrian")


def box(name: str, index: int) -> dict:
    return {"class": name, "center": [10.0 + 6 * index, 0.0, 1.0], "size_lwh": [4.0, 2.0, 1.5], "yaw": 0.0}


@pytest.fixture
def labelled(drive: Path) -> Path:
    """The small drive with the same five boxes in each frame, in the ego frame."""
    frames = [
        {
            "frame": 10 + number,
            "timestamp_ns": 1_000_000_000 + number * 500_000_000,
            "world_from_ego": {"translation": [10.0 + 5 * number, 0, 0], "rotation_wxyz": [1, 0, 0, 0]},
            "boxes": [box(name, place) for place, name in enumerate(CLASSES)],
        }
        for number in range(4)
    ]
    content = {"format": "bevcli-boxes/1", "frame_of_reference": "ego", "frames": frames}
    (drive / "ground_truth.json").write_text(json.dumps(content))
    return drive


def classes(sequence) -> list[str]:
    return sequence.load(0).ground_truth.classes.tolist()


def test_names_ignore_case_and_unknown_ones_are_named_once(labelled: Path) -> None:
    sequence = open_sequence(labelled)
    assert classes(sequence) == ["car", "truck", "Tricycle", "lorry", "pedestrian"]
    [note] = [note for note in sequence.notes if "other classes" in note]
    assert "8 boxes have other classes and are not scored: Tricycle (4), lorry (4)" in note


def test_a_class_map_renames_without_case(labelled: Path) -> None:
    sequence = open_sequence(labelled, class_map={"Lorry": "Truck", "tricycle": "bicycle"})
    assert classes(sequence) == ["car", "truck", "bicycle", "truck", "pedestrian"]
    assert not any("other classes" in note for note in sequence.notes)
    with pytest.raises(InputError, match=r'`class_map` .`--class-map`. Lorry=tank: "tank" is not a class'):
        open_sequence(labelled, class_map={"Lorry": "tank"})


def test_ground_truth_can_be_left_out_even_if_it_is_broken(labelled: Path) -> None:
    (labelled / "ground_truth.json").write_text("{")
    frame = open_sequence(labelled, ground_truth=False).load(0)
    assert frame.ground_truth is None
    assert frame.ground_truth_map is None


def test_convert_keeps_other_classes_and_applies_a_map_in_toml(labelled: Path, tmp_path: Path) -> None:
    table = tmp_path / "classes.toml"
    table.write_text('lorry = "truck"\n')
    out = tmp_path / "out"
    invoked("convert", labelled, out, "--class-map", table)
    found = read_boxes(out / "ground_truth.json").frames[0].boxes.classes.tolist()
    assert found == ["car", "truck", "Tricycle", "truck", "pedestrian"]


def test_eval_says_which_classes_it_left_out(labelled: Path, tmp_path: Path) -> None:
    content = json.loads((labelled / "ground_truth.json").read_text())
    for frame in content["frames"]:
        for one in frame["boxes"]:
            one["score"] = 0.9
    predictions = tmp_path / "predictions.json"
    predictions.write_text(json.dumps(content))
    arguments = ["eval", predictions, labelled, "--json"]
    scores = json.loads(invoked(*arguments).stdout)
    assert scores["label_ground_truth_boxes"]["truck"] == 4
    sides = [note for note in scores["notes"] if "Tricycle (4), lorry (4)" in note]
    assert len(sides) == 2
    scores = json.loads(invoked(*arguments, "--class-map", "LORRY=truck").stdout)
    assert scores["label_ground_truth_boxes"]["truck"] == 8
    assert np.isclose(scores["label_aps"]["truck"]["2.0"], 1)


def test_eval_cuts_the_ranges_where_the_models_grid_ends(labelled: Path, tmp_path: Path) -> None:
    content = json.loads((labelled / "ground_truth.json").read_text())
    for frame in content["frames"]:
        frame["boxes"] = [{**box("car", place), "score": 0.9} for place in (0, 4)]
    (labelled / "ground_truth.json").write_text(json.dumps(content))
    predictions = tmp_path / "predictions.json"
    predictions.write_text(json.dumps({**content, "range_m": 30.72}))
    arguments = ["eval", predictions, labelled, "--json"]
    scores = json.loads(invoked(*arguments).stdout)
    assert scores["label_ground_truth_boxes"]["car"] == 4  # at 10 m, but not at 34 m
    assert any("nothing beyond 30.72 m is scored" in note for note in scores["notes"])
    scores = json.loads(invoked(*arguments, "--max-range", "50").stdout)
    assert scores["label_ground_truth_boxes"]["car"] == 8
    assert not any("nothing beyond" in note for note in scores["notes"])
