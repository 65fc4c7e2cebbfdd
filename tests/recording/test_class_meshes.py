"""Meshes of classes: in the boxes of their class in the scene, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from memory_drive import MemoryDrive
from recorded_drive import TINY, NamedModel, boxes_ahead, predict

from bevcli.config import as_table, config_of_table
from bevcli.errors import InputError
from bevcli.geometry.object_classes import ClassSettings, are_nuscenes
from bevcli.recording import entities
from bevcli.recording.entities import class_colors
from bevcli.recording.writer import Recording
from bevcli.viewer.recording_reader import RecordingReader
from bevcli.workshop import meshes

CAR = class_colors(TINY.object_classes.values())["car"]


def with_mesh(path, name="car"):
    return replace(TINY, class_settings={name: ClassSettings(mesh=str(path))})


@pytest.fixture
def wedge(tmp_path):
    """A file of a wedge: its low edge is in front, and its places and lengths are not those of a car."""
    bottom, top = [(8, -1, 5), (8, 1, 5), (2, 1, 5), (2, -1, 5)], [(2, 1, 6), (2, -1, 6)]
    mesh = trimesh.convex.convex_hull(np.array([*bottom, *top], dtype=float))
    mesh.export(tmp_path / "wedge.ply")
    return tmp_path / "wedge.ply"


def drawn(frame):
    """(instances, vertices, 3) the mesh of cars as the viewer draws it, in the recording's world."""
    entity = entities.class_mesh("car")
    vertices = frame.array(entity, "Mesh3D:vertex_positions", 3)
    poses = [frame.array(entity, f"InstancePoses3D:{key}", n) for key, n in (("scales", 3), ("quaternions", 4))]
    places = frame.array(entity, "InstancePoses3D:translations", 3)
    turned = [
        trimesh.transformations.quaternion_matrix([w, x, y, z])[:3, :3] @ (vertices * scale).T
        for scale, (x, y, z, w) in zip(*poses, strict=True)
    ]
    return np.swapaxes(turned, 1, 2) + places[:, None]


def test_a_mesh_fills_the_boxes_of_its_class(tmp_path, wedge, in_this_process):
    drive = MemoryDrive(2)
    frames = [drive.load(place) for place in range(2)]
    with Recording(tmp_path / "r.rrd", drive, NamedModel(config=with_mesh(wedge))) as recording:
        recording.log(frames[0], predict(frames[0]))
        without = predict(frames[1])
        recording.log(frames[1], replace(without, boxes=without.boxes[without.boxes.classes != "car"]))
    first, second = RecordingReader(tmp_path / "r.rrd").frames()
    origin = frames[0].world_from_ego.translation
    car = boxes_ahead()[:1].transformed(frames[0].world_from_ego.matrix @ frames[0].rig.ego_from_bev)
    of_wedge = car.corners()[0, [0, 1, 2, 3, 5, 6]] - origin  # all four at the bottom, two above in the rear
    in_box, rest = drawn(first)
    away = np.linalg.norm(in_box[:, None] - of_wedge, axis=-1)
    np.testing.assert_allclose((away.min(0).max(), away.min(1).max()), 0, atol=1e-4)
    assert not np.ptp(rest, axis=0).any()
    assert not np.ptp(drawn(second), axis=1).any()  # a mesh without a size is not drawn
    colors = first.array(entities.class_mesh("car"), "Mesh3D:vertex_colors", 1).astype(np.uint32).ravel()
    assert {tuple(each.to_bytes(4, "big"))[:3] for each in colors.tolist()} == {CAR}
    assert first.array(entities.BOXES, "Boxes3D:centers", 3).shape == (2, 3)  # the outlines stay


def test_a_mesh_changes_no_result_nor_hash():
    config = config_of_table(as_table(TINY) | {"class_settings": {"car": {"mesh": "a/car.glb"}}}, "models/my.toml")
    assert config.object_classes["car"].mesh == "models/a/car.glb"
    assert repr(config) != repr(TINY)
    assert repr(config) == repr(config_of_table(as_table(TINY) | {"class_settings": {"car": {}}}, "my.toml"))
    assert as_table(config) == as_table(TINY)
    assert are_nuscenes(config.object_classes)


def test_without_a_mesh_there_is_no_entity(tmp_path):
    drive = MemoryDrive(1)
    frame = drive.load(0)
    with Recording(tmp_path / "r.rrd", drive, NamedModel()) as recording:
        recording.log(frame, predict(frame))
    assert not any("mesh" in chunk.entity_path for chunk in RecordingReader(tmp_path / "r.rrd").chunks())


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none.glb", None, "the file is missing"),
        ("two.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 1\nf 1 2 3\nf 2 3 4\n", "has 2 triangles .expected at most 1"),
        ("far.obj", b"v -1e10 0 0\nv 1e10 0 0\nv 0 1 0\nf 1 2 3\n", "or too large"),
    ],
)
def test_a_wrong_mesh_is_one_line_before_anything_is_written(
    tmp_path, in_this_process, monkeypatch, name, content, message
):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    monkeypatch.setattr(meshes, "MOST_TRIANGLES", 1)
    model = NamedModel(config=with_mesh(tmp_path / name))
    with pytest.raises(InputError, match=message) as caught, Recording(tmp_path / "r.rrd", MemoryDrive(1), model):
        pass
    assert str(caught.value).startswith(f'mesh of class "car": {tmp_path / name}: ')
    assert not (tmp_path / "r.rrd").exists()
