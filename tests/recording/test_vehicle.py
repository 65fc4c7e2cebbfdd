"""Meshes from files of several formats: the ego vehicle's, the default car, and those of classes."""

import os
from dataclasses import replace

import numpy as np
import PIL.Image
import pytest
import trimesh
from memory_drive import MemoryDrive
from recorded_drive import TINY, NamedModel, boxes_ahead, predict, record, recorded

from bevcli.config import as_table, config_of_table
from bevcli.errors import InputError
from bevcli.geometry.object_classes import ClassSettings, are_nuscenes
from bevcli.parsing.files import read_bytes
from bevcli.recording import RecordingOptions, entities
from bevcli.recording.entities import EGO_COLOR, class_colors
from bevcli.recording.meshes import default_vehicle
from bevcli.recording.writer import Recording
from bevcli.viewer.recording_reader import RecordingReader
from bevcli.workshop import meshes
from bevcli.workshop.meshes import load_vehicle, read_parts

RED = (200, 10, 20)


def van() -> trimesh.Trimesh:
    """A red box in the ego frame: x -1 to 4 m, y -1 to 1 m, z 0.3 to 2.3 m."""
    mesh = trimesh.creation.box(bounds=[(-1, -1, 0.3), (4, 1, 2.3)])
    mesh.visual.vertex_colors = (*RED, 255)
    return mesh


def assert_is_the_van(vehicle) -> None:
    np.testing.assert_allclose(vehicle.mesh.vertices.min(0), (-1, -1, 0.3), atol=1e-6)
    np.testing.assert_allclose(vehicle.mesh.vertices.max(0), (4, 1, 2.3), atol=1e-6)
    triangles = vehicle.mesh.vertices[vehicle.mesh.faces]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    outward = triangles.mean(1) - (1.5, 0, 1.3)
    assert ((normals * outward).sum(-1) > 0).all()
    np.testing.assert_allclose(np.abs(vehicle.mesh.normals).max(-1), 1)  # the edges of a box are sharp
    assert (vehicle.mesh.colors == RED).all()
    outline, arrow = vehicle.top_view
    np.testing.assert_allclose((outline.min(0), outline.max(0)), [(-1, -1), (4, 1)], atol=1e-6)
    assert 3 < arrow[1, 0] < 4  # its tip is at the front
    assert arrow[1, 1] == pytest.approx(0)


def test_a_ply_file_has_the_axes_of_the_ego_frame(tmp_path, in_this_process):
    van().export(tmp_path / "van.ply")
    assert_is_the_van(load_vehicle(tmp_path / "van.ply"))


def test_a_glb_file_has_the_axes_of_gltf(tmp_path, in_this_process):
    """y up, z forward, x left."""
    mesh = van()
    x, y, z = mesh.vertices.T
    turned = trimesh.Trimesh(np.column_stack([y, z, x]), mesh.faces, process=False)
    turned.visual.vertex_colors = (*RED, 255)
    turned.export(tmp_path / "van.glb")
    assert_is_the_van(load_vehicle(tmp_path / "van.glb"))


def test_the_parts_of_a_scene_keep_their_positions_and_colours(tmp_path, in_this_process):
    """One part has a material, one has no colour."""
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=(0, 255, 0, 255))
    painted, plain = (trimesh.creation.box((1, 1, 1)) for _ in range(2))
    painted.visual = trimesh.visual.TextureVisuals(material=material)
    scene = trimesh.Scene()
    for x, part in enumerate((painted, plain)):
        scene.add_geometry(part, transform=trimesh.transformations.translation_matrix((0, 0, 3 * x)))
    scene.export(tmp_path / "parts.glb")
    vehicle = load_vehicle(tmp_path / "parts.glb")
    part = np.round(vehicle.mesh.vertices[:, 0] / 3).astype(int)  # z of glTF is x of the ego frame
    assert set(part) == {0, 1}
    assert (vehicle.mesh.colors[part == 0] == (0, 255, 0)).all()
    assert (vehicle.mesh.colors[part == 1] == EGO_COLOR).all()


def test_colours_of_faces_do_not_mix(tmp_path, in_this_process):
    mesh = van()
    mesh.visual.face_colors = [(*RED, 255)] * 6 + [(0, 0, 255, 255)] * 6
    mesh.export(tmp_path / "van.ply")
    vehicle = load_vehicle(tmp_path / "van.ply")
    assert {tuple(color) for color in vehicle.mesh.colors.tolist()} == {RED, (0, 0, 255)}


def test_colours_are_taken_from_a_texture(tmp_path, in_this_process):
    """The left half of the texture is red, the right half blue; all vertices lie in the left half."""
    image = PIL.Image.fromarray(np.repeat([[RED] * 8 + [(0, 0, 255)] * 8], 16, axis=0).astype(np.uint8))
    mesh = van()
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    mesh.visual = trimesh.visual.TextureVisuals(uv=np.full((len(mesh.vertices), 2), 0.2), material=material)
    mesh.export(tmp_path / "van.glb")
    assert (load_vehicle(tmp_path / "van.glb").mesh.colors == RED).all()


def test_a_recording_has_the_mesh_of_the_file(tmp_path, in_this_process):
    van().export(tmp_path / "van.ply")
    record(tmp_path / "r.rrd", MemoryDrive(1), RecordingOptions(vehicle_mesh=tmp_path / "van.ply"))
    (frame,) = RecordingReader(tmp_path / "r.rrd").frames()
    vertices = frame.array(entities.VEHICLE, "Mesh3D:vertex_positions", 3)
    np.testing.assert_allclose((vertices.min(0), vertices.max(0)), [(-1, -1, 0.3), (4, 1, 2.3)], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("broken.glb", b"glTF and then something else", "trimesh cannot read"),
        ("notes.txt", b"a car", "is not a mesh file"),
        ("empty.ply", b"", "trimesh cannot read"),
        ("points.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles"),
        ("archive.zip", b"PK\x03\x04", "is not a mesh file"),
    ],
)
def test_a_file_without_a_mesh_is_an_error_of_one_line(tmp_path, capfd, in_this_process, name, content, message):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        load_vehicle(path)
    assert str(caught.value).startswith(str(path))
    assert capfd.readouterr().err == ""  # trimesh does not print its own message


def test_meshes_that_are_too_large_are_refused(tmp_path, in_this_process):
    van().apply_scale(1000).export(tmp_path / "van.stl")
    with pytest.raises(InputError, match="5000 x 2000 x 2000 m"):
        load_vehicle(tmp_path / "van.stl")
    with (tmp_path / "car.obj").open("wb") as file:
        file.truncate((16 << 20) + 1)
    with pytest.raises(InputError, match="at most 16 MiB"):
        load_vehicle(tmp_path / "car.obj")


TRIANGLE = "mtllib {}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl paint\nf 1 2 3\n"


@pytest.mark.parametrize("name", ["own.mtl", "pipe.mtl", "../secret.mtl", "missing.mtl"])
def test_a_mesh_reads_only_regular_files_of_its_folder(tmp_path, monkeypatch, name):
    """Read in this process, to see what is read."""
    folder, read = tmp_path / "mesh", []
    folder.mkdir()
    for path in (tmp_path / "secret.mtl", folder / "own.mtl"):
        path.write_text("newmtl paint\nKd 1 0 0\n")
    os.mkfifo(folder / "pipe.mtl")
    (folder / "car.obj").write_text(TRIANGLE.format(name))
    monkeypatch.setattr(meshes, "read_bytes", lambda path, most: read.append(path.name) or read_bytes(path, most))
    ((_, _, faces, _),) = read_parts(folder / "car.obj", RED)  # a part that is missing has no colour
    assert faces.tolist() == [[0, 1, 2]]
    assert ("secret.mtl" in read, "own.mtl" in read) == (False, name == "own.mtl")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limit", "value", "message"),
    [("MEMORY", 100 << 20, "takes more than 1 GiB of memory"), ("SECONDS", 0.05, "s to read")],
)
def test_a_mesh_that_takes_too_much_is_an_error_of_one_line(tmp_path, monkeypatch, limit, value, message):
    path = tmp_path / "sphere.ply"
    trimesh.creation.icosphere(subdivisions=7).export(path)  # 300,000 triangles
    monkeypatch.setattr(meshes, limit, value)
    with pytest.raises(InputError, match=message) as caught:
        load_vehicle(path)
    assert str(caught.value).startswith(str(path))


@pytest.mark.slow
def test_a_mesh_is_read_with_our_packages_not_the_folders(tmp_path, monkeypatch):
    van().export(tmp_path / "van.ply")
    for name in ("trimesh", "resource", "numpy"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    assert_is_the_van(load_vehicle(tmp_path / "van.ply"))
    assert not (tmp_path / "ran").exists()


@pytest.mark.slow
def test_an_error_in_the_process_of_a_mesh_is_one_line(tmp_path):
    (tmp_path / "empty.ply").touch()
    with pytest.raises(InputError, match=r"^\S*/empty.ply: trimesh cannot read this mesh file \(.*$"):
        load_vehicle(tmp_path / "empty.ply")


def test_the_default_car_stands_on_the_ground_and_faces_forward():
    car = default_vehicle()
    low, high = car.mesh.vertices.min(0), car.mesh.vertices.max(0)
    assert low[2] == pytest.approx(0, abs=0.01)
    assert high[0] > -low[0]  # the origin is under the rear axle
    np.testing.assert_allclose(np.linalg.norm(car.mesh.normals, axis=-1), 1)
    outline, _ = car.top_view
    np.testing.assert_allclose(outline.max(0), high[:2], atol=0.01)


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
    found, without = map(predict, frames)
    without = replace(without, boxes=without.boxes[without.boxes.classes != "car"])
    steps = zip(frames, (found, without), strict=True)
    first, second = recorded(tmp_path / "r.rrd", drive, steps, NamedModel(config=with_mesh(wedge)))
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
    recorded(tmp_path / "r.rrd", drive, [(frame, predict(frame))])
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
