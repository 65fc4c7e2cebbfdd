"""`bevcli export --format openlabel` and `kitti-raw`: tracks, by the rules of the formats and read back by hand."""

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from typer.testing import CliRunner

from bevcli.cli.main import app
from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Pose, rigid, rotation_about_z, rotation_from_quaternion
from bevcli.sequences.files.boxes_file import BoxesFile, BoxesWriter, FrameBoxes
from bevcli.workshop.formats.boxes.openlabel import openlabel

# Per frame: instance, x in the ego frame, class. The car is missed in the third frame; the last box has no track.
SEEN = (
    [("a", 10.0, "car"), ("b", 20.0, "pedestrian")],
    [("a", 12.0, "car")],
    [("b", 22.0, "pedestrian"), ("b", 23.0, "pedestrian")],
    [("a", 16.0, "truck"), ("", 5.0, "traffic_cone")],
)


def boxes_of(rows) -> Boxes3D:
    names, xs, classes = zip(*rows, strict=True)
    count = len(rows)
    return Boxes3D(
        np.column_stack([xs, np.full(count, -3.0), np.full(count, 1.0)]),
        np.tile([4.0, 2.0, 1.5], (count, 1)),
        np.full(count, 0.5),
        np.tile([1.0, np.nan], (count, 1)),
        np.array(classes),
        scores=np.full(count, 0.9),
        instances=np.array(names),
        track_scores=np.full(count, np.nan),
    )


def pose(place: int) -> Pose:
    return Pose.from_matrix(rigid((5.0 * place, 0, 0), rotation_about_z(0.2 * place)))


@pytest.fixture(scope="module")
def predictions(tmp_path_factory) -> Path:
    """predictions.json in the world frame."""
    path = tmp_path_factory.mktemp("tracks") / "predictions.json"
    with BoxesWriter(path, "world", {"model": "demo"}) as writer:
        for place, rows in enumerate(SEEN):
            stamp = FrameStamp(10 + place, "one", 10**18 + place * 500_000_000)
            writer.write(FrameBoxes(stamp, pose(place), boxes_of(rows).transformed(pose(place).matrix)))
    return path


def export(path: Path, form: str):
    return CliRunner().invoke(app, ["export", str(path), "--format", form])


@pytest.fixture(scope="module")
def label(predictions):
    assert export(predictions, "openlabel").exit_code == 0
    return json.loads((predictions.parent / "openlabel.json").read_text())["openlabel"]


def test_openlabel_keeps_the_rules_of_the_schema(label):
    """Those of ASAM's openlabel_json_schema 1.0.0 for the parts that are written."""
    assert label.keys() == {"metadata", "coordinate_systems", "objects", "frames", "frame_intervals"}
    assert label["metadata"]["schema_version"] == "1.0.0"
    for system in label["coordinate_systems"].values():
        assert {"type", "parent"} <= system.keys() <= {"type", "parent", "children", "pose_wrt_parent"}
    assert all(re.fullmatch("-?[0-9]+", key) for key in label["objects"])
    for one in label["objects"].values():
        assert one.keys() == {"name", "type", "frame_intervals"}
        assert all(span.keys() == {"frame_start", "frame_end"} for span in one["frame_intervals"])
    for number, frame in label["frames"].items():
        assert re.fullmatch("[0-9]+", number)
        assert frame.keys() == {"frame_properties", "objects"}
        assert frame["objects"].keys() <= label["objects"].keys()
        for one in frame["objects"].values():
            [cuboid] = one["object_data"]["cuboid"]
            assert {"name", "val"} <= cuboid.keys()
            assert len(cuboid["val"]) == 10
            assert cuboid["coordinate_system"] in label["coordinate_systems"]
            assert cuboid["attributes"].keys() <= {"num", "text"}


def test_openlabel_is_valid_by_the_schema_of_vcd(label):
    schema = pytest.importorskip("vcd.schema", reason="vcd is not installed: pip install vcd jsonschema")
    jsonschema = pytest.importorskip("jsonschema")
    jsonschema.Draft7Validator(schema.openlabel_schema).validate({"openlabel": label})


def test_openlabel_has_an_object_a_track(label):
    found = [(one["name"], one["type"], spans(one)) for one in label["objects"].values()]
    assert found == [
        ("car a", "car", [(10, 11), (13, 13)]),
        ("pedestrian b", "pedestrian", [(10, 10), (12, 12)]),
        ("pedestrian b", "pedestrian", [(12, 12)]),  # a second box of the object in one frame
        ("traffic_cone without track 3", "traffic_cone", [(13, 13)]),
    ]


def spans(one):
    return [(span["frame_start"], span["frame_end"]) for span in one["frame_intervals"]]


def test_openlabel_cuboids_are_where_the_vehicle_saw_them(label):
    frame = label["frames"]["13"]
    transform = frame["frame_properties"]["transforms"]["ego_to_world"]
    matrix = np.reshape(transform["transform_src_to_dst"]["matrix4x4"], (4, 4))
    np.testing.assert_allclose(matrix, pose(3).matrix, atol=1e-12)
    [cuboid] = frame["objects"]["0"]["object_data"]["cuboid"]
    x, y, z, qx, qy, qz, qw, *size = cuboid["val"]
    np.testing.assert_allclose([x, y, z, 1], matrix @ [16, -3, 1, 1])
    np.testing.assert_allclose(rotation_from_quaternion([qw, qx, qy, qz]), rotation_about_z(0.5 + 0.6), atol=1e-9)
    assert size == [4.0, 2.0, 1.5]
    assert [one["name"] for one in cuboid["attributes"]["num"]] == ["score"]  # the others are unknown
    assert frame["frame_properties"]["timestamp"] == "2001-09-09T01:46:41.500000000Z"


def test_openlabel_refuses_repeated_frame_indices():
    frames = tuple(FrameBoxes(FrameStamp(0, scene, 5), None, boxes_of(SEEN[0])) for scene in "ab")
    with pytest.raises(InputError, match="frame indices repeat"):
        openlabel(BoxesFile("ego", frames))


def tracklets(path: Path):
    """Tracklets as KITTI's development kit reads them: type, size h w l, first frame, poses (N, 6) and states."""
    root = ElementTree.parse(path).getroot()
    [listed] = root
    items = listed.findall("item")
    assert int(listed.find("count").text) == len(items)
    for item in items:
        poses = item.find("poses").findall("item")
        assert int(item.find("poses/count").text) == len(poses)
        rows = [[float(one.find(name).text) for name in ("tx", "ty", "tz", "rx", "ry", "rz")] for one in poses]
        size = [float(item.find(name).text) for name in "hwl"]
        states = [int(one.find("state").text) for one in poses]
        yield item.find("objectType").text, size, int(item.find("first_frame").text), np.array(rows), states


def test_kitti_raw_has_a_tracklet_a_track(predictions):
    assert export(predictions, "kitti-raw").exit_code == 0
    found = list(tracklets(predictions.parent / "kitti_raw/one/tracklet_labels.xml"))
    assert [(kind, first) for kind, _, first, _, _ in found] == [
        ("Car", 0), ("Pedestrian", 0), ("Pedestrian", 2), ("TrafficCone", 3),
    ]  # fmt: skip
    _, size, _, rows, states = found[0]
    assert size == [1.5, 2.0, 4.0]
    assert states == [2, 2, 1, 2]  # the third is interpolated
    np.testing.assert_allclose(rows[:, 0], [10, 12, 14, 16], atol=1e-6)
    np.testing.assert_allclose(rows[:, 2], 0.25, atol=1e-6)  # the bottom
    np.testing.assert_allclose(rows[:, 5], 0.5, atol=1e-6)


def test_the_first_of_each_class_is_declared(predictions):
    export(predictions, "kitti-raw")
    text = (predictions.parent / "kitti_raw/one/tracklet_labels.xml").read_text()
    assert text.startswith('<?xml version="1.0" encoding="UTF-8" standalone="yes"?>\n<!DOCTYPE boost_serialization>\n')
    assert [text.count(f'class_id="{number}"') for number in range(4)] == [1, 1, 1, 1]


def test_scenes_that_are_no_file_names_are_refused(tmp_path):
    with BoxesWriter(tmp_path / "predictions.json", "ego") as writer:
        writer.write(FrameBoxes(FrameStamp(0, "../up", 5), None, boxes_of(SEEN[0])))
    answer = export(tmp_path, "kitti-raw")
    assert 'scene "../up": cannot be the name of a folder' in str(answer.exception)
    assert not (tmp_path / "up").exists()


def test_boxes_in_the_bev_frame_need_its_pose(tmp_path):
    with BoxesWriter(tmp_path / "predictions.json", "bev") as writer:
        writer.write(FrameBoxes(FrameStamp(0, "", 5), None, boxes_of(SEEN[0])))
    assert 'does not state "ego_from_bev"' in str(export(tmp_path, "kitti-raw").exception)
    assert export(tmp_path, "openlabel").exit_code == 0


def test_an_unknown_format_names_the_known_ones(predictions):
    assert "--format dxf: unknown format (expected csv, json, kitti, " in str(export(predictions, "dxf").exception)
