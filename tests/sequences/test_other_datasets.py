"""DGP, Argoverse 2 and T4: real data, a drive of ours written in each format and read back, and broken files."""

import json
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from pkgutil import resolve_name

import cv2
import numpy as np
import pyarrow as pa
import pytest
from command_line import invoked
from pyarrow import feather
from written_formats import RING, WRITTEN

from bevcli.errors import InputError
from bevcli.frame import Drive, Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Distortion
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.geometry.transforms import inverse
from bevcli.registry import load
from bevcli.rig.check_calibration import check_rig
from bevcli.sequences.format import Format, format_of
from bevcli.sequences.open import open_sequence
from bevcli.workshop.formats.labels import with_track_velocities

FORMATS: dict[str, type[Format]] = {name: load("bevcli.sequences", name) for name in WRITTEN}
TABLES = {"dgp": "scene_s.json", "argoverse2": "annotations.feather", "t4": "annotation/sample_data.json"}
LENS = Distortion("brown_conrady", (-0.24, -0.21, 0.0, 0.0, 0.32))  # as of a camera of Argoverse 2
DOCUMENT = (Path(__file__).parents[2] / "docs/other-inputs.md").read_text()
SAMPLE = Path(__file__).parents[2] / "samples/street"
ROW = re.compile(r"^\| `(.+?)` +\| `?(\w+|–)`? +\|", flags=re.MULTILINE)


@pytest.fixture(scope="module")
def street() -> list[Frame]:
    """Three frames of the sample drive, with a lens on the front camera."""
    drive = open_sequence(SAMPLE, frames=slice(0, 3))
    frames = [drive.load(place) for place in range(3)]
    front = replace(drive.rig.cameras[0], distortion=LENS)
    rig = replace(drive.rig, cameras=(front, *drive.rig.cameras[1:]))
    return [replace(frame, rig=rig) for frame in frames]


@pytest.fixture(scope="module", params=list(WRITTEN))
def written(request, street, tmp_path_factory) -> tuple[str, Path]:
    """The name of a format, and the street in it."""
    folder = tmp_path_factory.mktemp(request.param) / "street"
    WRITTEN[request.param].write(street, folder)
    return request.param, folder


@pytest.fixture
def copied(written, tmp_path) -> tuple[str, Path]:
    """The name of a format, and a copy of the street in it that a test may break."""
    shutil.copytree(written[1], tmp_path / "street")
    return written[0], tmp_path / "street"


@pytest.mark.parametrize("name", list(WRITTEN))
def test_only_its_own_format_recognises_a_drive(name, street, tmp_path):
    WRITTEN[name].write([replace(street[0], images={})], tmp_path)
    assert [other for other, one in FORMATS.items() if one.recognises(tmp_path)] == [name]


def test_written_frames_are_read_back(written, street):
    """Argoverse 2 cameras have other names; they are compared in the order of the rig."""
    name, folder = written
    assert format_of(folder) is FORMATS[name]
    drive = open_sequence(folder, **WRITTEN[name].options)
    assert [stamp.timestamp_ns for stamp in drive.stamps] == [frame.stamp.timestamp_ns for frame in street]
    for place, frame in enumerate(street):
        read = drive.load(place)
        names = RING[: len(read.rig.names)] if name == "argoverse2" else frame.rig.names
        np.testing.assert_allclose(read.world_from_ego.matrix, frame.world_from_ego.matrix, atol=1e-6)
        np.testing.assert_allclose(read.rig.ego_from_bev, frame.rig.ego_from_bev, atol=1e-6)
        for ours, theirs in zip(frame.rig.names, names, strict=True):
            camera, other = frame.rig[ours], read.rig[theirs]
            np.testing.assert_allclose(other.intrinsics, camera.intrinsics, atol=1e-9)
            np.testing.assert_allclose(other.ego_from_camera, camera.ego_from_camera, atol=1e-9)
            assert other.distortion == camera.distortion
            assert read.images[theirs].encoded == frame.images[ours].encoded
            pose, expected = read.world_from_ego_at[theirs], frame.world_from_ego_at[ours]
            np.testing.assert_allclose(pose.matrix, expected.matrix, atol=1e-6)


def test_written_boxes_are_read_back(written, street):
    """All ten classes are in the street. Velocities follow from the positions of the objects."""
    drive = open_sequence(written[1])
    frame, read = street[1], drive.load(1)
    a, b = frame.ground_truth, read.ground_truth
    assert set(a.classes) == set(NUSCENES_CLASSES)
    b = b[_pairing(a, b)]
    np.testing.assert_allclose(b.centers, a.centers, atol=1e-5)
    np.testing.assert_allclose(b.sizes_lwh, a.sizes_lwh, atol=1e-9)
    np.testing.assert_allclose(np.cos(b.yaws - a.yaws), 1, atol=1e-6)
    assert b.classes.tolist() == a.classes.tolist()
    assert (b.num_points == 7).all()
    if written[0] == "argoverse2":
        renamed = open_sequence(written[1], class_map={"BOX_TRUCK": "bus"})
        assert "truck" not in renamed.load(0).ground_truth.classes
    before, after = street[0].ground_truth, street[2].ground_truth
    moved = dict(zip(before.instances, before.centers, strict=True))
    for instance, center in zip(after.instances, after.centers, strict=True):
        if instance in moved and instance in a.instances:
            velocity = b.velocities[a.instances.tolist().index(instance)]
            np.testing.assert_allclose(velocity, (center - moved[instance])[:2], atol=1e-3)


def _pairing(a: Boxes3D, b: Boxes3D) -> np.ndarray:
    """(N,) the row in b of each box of a, by its position."""
    distances = np.linalg.norm(a.centers[:, None] - b.centers[None], axis=-1)
    assert distances.shape[0] == distances.shape[1]
    return distances.argmin(axis=1)


def test_a_missing_image_is_dropped_or_an_error(copied):
    _, folder = copied
    image = sorted(folder.rglob("*.jpg"))[0]
    image.unlink()
    found = open_sequence(folder)
    reasons = [reason for place in range(len(found.stamps)) for reason in found.load(place).dropped.values()]
    assert len(reasons) == 1
    with pytest.raises(InputError, match=r'has its own ego-motion: remove `ego_motion="static"`'):
        open_sequence(folder, ego_motion="static")
    assert "missing" in reasons[0] or "has no image within" in reasons[0]
    strict = open_sequence(folder, strict=True)
    with pytest.raises(InputError, match=r"has no image within|is missing"):
        list(map(strict.load, range(len(strict.stamps))))


def _pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


BREAKS: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "cut off": lambda path: path.write_bytes(path.read_bytes()[:-200]),
    "no table": lambda path: path.write_text("[3, "),
    "a pipe": _pipe,
    "a folder": lambda path: (path.unlink(), path.mkdir()),
}


@pytest.mark.parametrize("kind", list(BREAKS))
def test_a_broken_table_is_named_in_one_line(copied, kind):
    name, folder = copied
    BREAKS[kind](folder / TABLES[name])
    _assert_refused(folder, TABLES[name])


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("dgp", "calibration/c.json"),
        ("dgp", "ontology/o.json"),
        ("dgp", "bounding_box_3d/LIDAR/0.json"),
        ("argoverse2", "calibration/intrinsics.feather"),
        ("argoverse2", "calibration/egovehicle_SE3_sensor.feather"),
        ("argoverse2", "city_SE3_egovehicle.feather"),
        ("t4", "annotation/calibrated_sensor.json"),
        ("t4", "annotation/ego_pose.json"),
    ],
)
def test_a_missing_table_is_named_in_one_line(name, file, street, tmp_path):
    WRITTEN[name].write(street[:1], tmp_path / "street")
    (tmp_path / "street" / file).unlink()
    _assert_refused(tmp_path / "street", file)


def _assert_refused(folder: Path, file: str) -> None:
    with pytest.raises(InputError) as error:
        open_sequence(folder)
    assert file in str(error.value)


@pytest.mark.parametrize(
    ("column", "values", "expected"),
    [
        ("k1", ["bent"] * 6, '"k1": expected double, found string'),
        ("k1", [None] * 6, '"k1": expected double, found null with missing values'),
        ("fx_px", [float("nan")] * 6, "expected finite numbers"),
        ("fx_px", [-1.0] * 6, "expected fx > 0 and fy > 0"),
        ("width_px", [0.5] * 6, '"width_px": expected int64, found double'),
        ("sensor_name", ["ring_front_center"] * 6, "two of one camera"),
        ("cx_px", None, 'no column "cx_px"'),
    ],
)
def test_a_wrong_column_is_named(column, values, expected, street, tmp_path):
    WRITTEN["argoverse2"].write(street[:1], tmp_path)
    path = tmp_path / "calibration/intrinsics.feather"
    table = feather.read_table(path).drop_columns(column)
    feather.write_feather(table if values is None else table.append_column(column, pa.array(values)), path)
    with pytest.raises(InputError, match=expected):
        open_sequence(tmp_path)


@pytest.mark.parametrize(
    ("file", "old", "new", "expected"),
    [
        ("calibration/c.json", '"fx": 6', '"fx": -6', "fx > 0 and fy > 0"),
        ("calibration/c.json", '"skew": 0.0', '"xi": 0.5', '"xi", which is not supported'),
        ("calibration/c.json", '"names": ["LIDAR", ', '"names": [', "as many names as intrinsics"),
        ("scene_s.json", '"qw": ', '"qw": "a", "q": ', "rotation[...]: expected `float`, got `str`"),
        ("scene_s.json", '"filename": "rgb', '"filename": "../rgb', "0.jpg: leads out of the folder"),
        ("scene_s.json", '"timestamp": "2023', '"timestamp": "May 2023', "id.timestamp: invalid RFC3339"),
        ("scene_s.json", '"key": "lidar0"', '"key": "radar0"', 'datum "lidar0", which is missing'),
        ("scene_s.json", '"samples": [', '"samples": 3, "s": [', "samples: expected `array`, got `int`"),
    ],
)
def test_a_wrong_member_of_dgp_is_named(file, old, new, expected, street, tmp_path):
    WRITTEN["dgp"].write(street[:1], tmp_path)
    text = (tmp_path / file).read_text()
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=re.escape(expected)) as error:
        open_sequence(tmp_path)
    assert file in str(error.value) or "leads out" in expected  # which names the image


def test_a_wrong_lens_of_t4_is_named(street, tmp_path):
    WRITTEN["t4"].write(street[:1], tmp_path)
    path = tmp_path / "annotation/calibrated_sensor.json"
    path.write_text(path.read_text().replace("-0.24, ", "-0.24, 1.0, ", 1))
    with pytest.raises(InputError, match=r'calibrated_sensor.json: "camera_distortion": expected 0, 4, 5 or 8 numbers'):
        open_sequence(tmp_path)


@pytest.mark.parametrize(("name", "form"), [*((name, "native") for name in WRITTEN), ("t4", "nuscenes")])
def test_impossible_boxes_are_left_out_with_their_number(name, form, street, tmp_path):
    sizes = street[0].ground_truth.sizes_lwh.copy()
    sizes[0], sizes[1, 2] = 0, -1.5
    WRITTEN[name].write(
        [replace(street[0], ground_truth=replace(street[0].ground_truth, sizes_lwh=sizes))], tmp_path / "in"
    )
    result = invoked("convert", tmp_path / "in", tmp_path / "out", "--format", form)
    assert "2 boxes of the ground truth left out" in result.output
    assert len(open_sequence(tmp_path / "out").load(0).ground_truth) == len(sizes) - 2


def test_a_size_that_is_no_number_is_named(street, tmp_path):
    sizes = street[0].ground_truth.sizes_lwh.copy()
    sizes[3, 0] = np.nan
    truth = replace(street[0].ground_truth, sizes_lwh=sizes)
    WRITTEN["argoverse2"].write([replace(street[0], ground_truth=truth)], tmp_path)
    with pytest.raises(InputError, match=r'"length_m": expected finite numbers below 1e12, found nan in row 3'):
        open_sequence(tmp_path)


def test_a_camera_without_image_in_a_sample_of_dgp_is_missing(street, tmp_path):
    name = street[0].rig.names[1]
    without = replace(street[1], images={one: image for one, image in street[1].images.items() if one != name})
    WRITTEN["dgp"].write([street[0], without, replace(street[2], images={})], tmp_path)
    drive = open_sequence(tmp_path)
    assert [sorted(drive.load(place).dropped) for place in range(3)] == [[], [name], sorted(street[0].rig.names)]
    assert [drive.load(place).rig.names for place in range(3)] == [street[0].rig.names] * 3
    WRITTEN["dgp"].write([replace(frame, images={}) for frame in street], tmp_path / "none")
    _assert_refused(tmp_path / "none", "scene_s.json: no sample has an image")


@pytest.mark.parametrize("table", ["category", "sensor", "calibrated_sensor", "ego_pose", "sample", "scene"])
def test_a_reference_of_t4_that_leads_nowhere_is_named(table, street, tmp_path):
    WRITTEN["t4"].write(street[:1], tmp_path)
    _lose_one_row(tmp_path / f"annotation/{table}.json")
    _assert_refused(tmp_path, f"{table}.json")


@pytest.mark.parametrize("table", ["instance", "visibility"])
def test_boxes_of_t4_are_kept_or_left_out_with_a_number(table, street, tmp_path):
    WRITTEN["t4"].write(street[:1], tmp_path)
    _lose_one_row(tmp_path / f"annotation/{table}.json")
    drive, boxes = open_sequence(tmp_path), len(street[0].ground_truth)
    lost = 1 if table == "instance" else 0
    assert len(drive.load(0).ground_truth) == boxes - lost
    assert any(f"{lost} of {boxes} boxes are left out" in note for note in drive.notes) == bool(lost)


def _lose_one_row(path: Path) -> None:
    """Rename the token of the last row of a table."""
    *rows, last = json.loads(path.read_text())
    path.write_text(json.dumps([*rows, {**last, "token": "lost"}]))


def test_boxes_without_an_instance_have_no_velocity():
    """An object that moves by 1 m in half a second has a velocity, two that are nobody's have none."""
    one = Boxes3D(np.zeros((2, 3)), np.ones((2, 3)), np.zeros(2), np.full((2, 2), np.nan), np.array(["car"] * 2))
    one = replace(one, instances=np.array(["", "a"]))
    found = with_track_velocities(
        [one, Boxes3D.empty(), replace(one, centers=one.centers + 1)], [0, 250_000_000, 500_000_000]
    )
    assert np.isnan(found[0].velocities[0]).all()
    assert found[2].velocities[1].tolist() == [2.0, 2.0]


@pytest.mark.parametrize("name", list(WRITTEN))
def test_the_document_has_all_class_names(name):
    """Its table has the rows of the mapping, and others that have no class."""
    mapping = resolve_name(WRITTEN[name].mapping)
    section = DOCUMENT.split(f"<!-- {name} -->")[1].split("<!--")[0]
    rows = {one: target for names, target in ROW.findall(section) for one in names.split("`, `")}
    assert {one: target for one, target in rows.items() if target != "–"}.items() >= mapping.items()
    assert set(mapping.values()) <= set(NUSCENES_CLASSES)


# Real data.


def _rig_has_no_error(drive: Drive) -> None:
    assert not [finding for finding in check_rig(drive.rig).findings if finding.severity == "error"]


def test_boxes_of_ddad_agree_with_those_of_its_cameras(shared):
    """The scene states each box a second time, in the frame of a camera, 21 ms later. Parked cars have not moved."""
    folder = shared / "data/dgp-scene_01"
    drive = open_sequence(folder)
    _rig_has_no_error(drive)
    frame = drive.load(0)
    boxes, camera = frame.ground_truth, "CAMERA_01"
    camera_from_world = frame.rig[camera].camera_from_ego @ inverse(frame.world_from_ego_at[camera].matrix)
    file = folder / f"bounding_box_3d/{camera}/15569195938415230.json"
    parked = 0
    for stated in json.loads(file.read_text())["annotations"]:
        row = boxes.instances.tolist().index(str(stated["instance_id"]))
        expected = [stated["box"]["pose"]["translation"][axis] for axis in "xyz"]
        center = camera_from_world[:3, :3] @ boxes.centers[row] + camera_from_world[:3, 3]
        if np.linalg.norm(boxes.velocities[row]) < 0.1:
            parked += 1
            np.testing.assert_allclose(center, expected, atol=0.02)
    assert parked > 5


def test_times_of_ddad_give_speeds_of_cars(shared):
    """The times in the file are ten times too far apart: cars on the road would drive at 1.5 m/s."""
    drive = open_sequence(shared / "data/dgp-scene_01")
    assert any("ten times too large" in note for note in drive.notes)
    assert np.diff([stamp.timestamp_ns for stamp in drive.stamps]) == pytest.approx(1e8, rel=0.01)
    speeds = np.linalg.norm(drive.load(1).ground_truth.velocities, axis=1)
    assert 8 < np.median(speeds[speeds > 5]) < 20


@pytest.fixture
def argoverse2_log(shared, tmp_path) -> Path:
    """The real log with grey images of two cameras at two of its times."""
    folder = tmp_path / "log"
    shutil.copytree(shared / "data/argoverse2-log", folder, copy_function=shutil.copyfile)
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o755)
    for name, size in (("ring_front_center", (1550, 2048)), ("ring_side_left", (2048, 1550))):
        (folder / "sensors/cameras" / name).mkdir(parents=True)
        for time in (315966253660357000, 315966253760553000):
            cv2.imwrite(
                str(folder / f"sensors/cameras/{name}/{time + 12_000_000}.jpg"), np.full(size[::-1], 90, np.uint8)
            )
    return folder


@pytest.mark.slow
def test_objects_of_argoverse2_stand_on_the_ground(argoverse2_log):
    """Argoverse's origin is the rear axle: without the option, objects around the vehicle stand 0.34 m below z = 0."""
    drive = open_sequence(argoverse2_log)
    _rig_has_no_error(drive)
    for axle_height_m, expected in ((0.33, 0.0), (0.0, -0.33)):
        drive = open_sequence(argoverse2_log, axle_height_m=axle_height_m)
        frame = drive.load(0)
        boxes = frame.ground_truth.transformed(inverse(frame.world_from_ego.matrix))
        near = np.linalg.norm(boxes.centers[:, :2], axis=1) < 15
        bottoms = (boxes.centers[:, 2] - boxes.sizes_lwh[:, 2] / 2)[near]
        assert np.median(bottoms) == pytest.approx(expected, abs=0.15)


def test_frames_of_argoverse2_are_those_with_images(argoverse2_log):
    drive = open_sequence(argoverse2_log)
    assert [stamp.index for stamp in drive.stamps] == [0, 1]
    assert any("154 of 156 frames have no image" in note for note in drive.notes)
    assert any("bollard" in note.lower() for note in drive.notes)
    frame = drive.load(0)
    assert set(frame.images) == {"ring_front_center", "ring_side_left"}
    assert "within 26 ms" in frame.dropped["ring_rear_left"]
    assert len(frame.rig.names) == 7
    assert len(open_sequence(argoverse2_log, stereo=True).rig.names) == 9
    assert open_sequence(argoverse2_log, distorted=True).rig.cameras[0].distortion is not None
    shutil.rmtree(argoverse2_log / "sensors/cameras")
    with pytest.raises(InputError, match="sensors/cameras: has no images"):
        open_sequence(argoverse2_log)


def test_the_sample_of_t4_is_read(shared):
    """Its car stands 10 m ahead and 5 m to the left of the vehicle, which is at the origin."""
    drive = open_sequence(shared / "data/t4dataset-sample")
    assert drive.rig.names == ("CAM_FRONT", "CAM_BACK")
    assert [stamp.timestamp_ns for stamp in drive.stamps] == [1704067200000000000 + k * 10**9 for k in range(3)]
    boxes = drive.load(0).ground_truth
    car = boxes.classes == "car"
    assert boxes.centers[car].tolist() == [[10.0, 5.0, 1.0]]
    assert boxes.visibilities[car] == [1.0]
    assert set(boxes.attributes) == {""}  # not those of nuScenes
    assert not drive.load(1).dropped
