"""The rig of a drive, written as other programs write it by hand, is read back; what is not certain is asked."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

import bevcli
from bevcli.errors import InputError
from bevcli.sequences.files.calibration_file import draft_of
from bevcli.sequences.options import RigOptions
from bevcli.workshop.synth.rig import RigDistribution, draw_rig

STREET = Path(__file__).parents[2] / "samples/street"
FACTS = json.loads((STREET / "calibration.json").read_text())["cameras"]
NAMES = tuple(FACTS)
SIZE = (FACTS[NAMES[0]]["width"], FACTS[NAMES[0]]["height"])
D = [-0.1, 0.02, 0.001, -0.002, 0.003]


def pose(name, *, axes=None):
    """(4, 4) ego_from_camera. axes: (3, 3), camera_from_axes."""
    stated = FACTS[name]["ego_from_camera"]
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(stated["rotation"]) @ (np.eye(3) if axes is None else axes)
    matrix[:3, 3] = stated["translation"]
    return matrix


def k_of(name):
    return np.array(FACTS[name]["intrinsics"])


def four(name):
    """fx, fy, cx, cy."""
    return k_of(name)[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()


def read(path, drive=STREET, **how):
    return draft_of(RigOptions(calibration=path, **how), drive)


def written(folder, content, name="rig.yaml"):
    path = folder / name
    path.parent.mkdir(exist_ok=True, parents=True)
    if not isinstance(content, str):
        content = yaml.safe_dump(content, sort_keys=False) if path.suffix == ".yaml" else json.dumps(content)
    path.write_text(content)
    return path


def assert_is_the_street(rig, names=NAMES, *, lens=False):
    assert sorted(rig.names) == sorted(names)
    for name, own in zip(sorted(names), sorted(NAMES), strict=True):
        camera = rig[name]
        assert (camera.width, camera.height) == SIZE
        np.testing.assert_allclose(camera.intrinsics, k_of(own), atol=1e-6)
        np.testing.assert_allclose(camera.ego_from_camera, pose(own), atol=1e-5)
        assert (camera.distortion is not None) == lens


OPENGL = np.diag([1.0, -1.0, -1.0])
VEHICLE = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


def entry(name, **more):
    return {"K": k_of(name).tolist(), "D": D, **more}


SPELLINGS = {
    "T_ego_cam": lambda name: entry(name, T_ego_cam=pose(name).tolist()),
    "T_cam_ego": lambda name: entry(name, T_cam_ego=np.linalg.inv(pose(name)).tolist()),
    "cam2ego": lambda name: entry(name, cam2ego=pose(name).ravel().tolist()),
    "T_cam_ego but vehicle from camera": lambda name: entry(name, T_cam_ego=pose(name).tolist()),
    "extrinsics, either way": lambda name: entry(name, extrinsics=np.linalg.inv(pose(name)).tolist()),
    "axes of the vehicle": lambda name: entry(name, transform=pose(name, axes=VEHICLE).tolist()),
    "R and T": lambda name: entry(name, R=pose(name)[:3, :3].tolist(), T=pose(name)[:3, 3].tolist()),
    "rvec and tvec": lambda name: entry(
        name,
        rvec=Rotation.from_matrix(pose(name)[:3, :3].T).as_rotvec().tolist(),
        tvec=np.linalg.inv(pose(name))[:3, 3].tolist(),
    ),
    "intrinsics by name": lambda name: {
        "intrinsics": dict(zip(("fx", "fy", "cx", "cy"), four(name), strict=True)),
        "distortion": dict(zip(("k1", "k2", "p1", "p2", "k3"), D, strict=True)),
        "extrinsics": {"translation": pose(name)[:3, 3].tolist(), "rotation": pose(name)[:3, :3].tolist()},
    },
    "a matrix with its shape": lambda name: {
        "camera_matrix": {"rows": 3, "cols": 3, "data": k_of(name).ravel().tolist()},
        "dist_coeffs": [D],
        "T_vehicle_camera": {"rows": 4, "cols": 4, "data": pose(name).ravel().tolist()},
    },
    "Autoware.AI": lambda name: {
        "CameraMat": k_of(name).ravel().tolist(),
        "DistCoeff": D,
        "ImageSize": [800, 450],
        "CameraExtrinsicMat": pose(name).ravel().tolist(),
    },
    "flat": lambda name: {
        **dict(zip(("fx", "fy", "cx", "cy"), four(name), strict=True)),
        "D": D,
        **dict(zip(("tx", "ty", "tz"), pose(name)[:3, 3].tolist(), strict=True)),
        **dict(zip(("qx", "qy", "qz", "qw"), Rotation.from_matrix(pose(name)[:3, :3]).as_quat().tolist(), strict=True)),
    },
    "by column, P, shares": lambda name: {
        "P": np.c_[k_of(name) / [[800], [450], [1]], np.zeros(3)].tolist(),
        "width": 800,
        "height": 450,
        "D": D,
        "T": pose(name).T.tolist(),
    },
    "quaternion": lambda name: entry(
        name,
        pose={
            "position": dict(zip("xyz", pose(name)[:3, 3].tolist(), strict=True)),
            "orientation": dict(zip("xyzw", Rotation.from_matrix(pose(name)[:3, :3]).as_quat().tolist(), strict=True)),
        },
    ),
}


def turned(name):
    return Rotation.from_matrix(pose(name)[:3, :3])


SPELLINGS |= {
    "sensor2ego_rotation": lambda name: entry(name, sensor2ego_rotation=turned(name).as_quat().tolist(),
                                              sensor2ego_translation=pose(name)[:3, 3].tolist()),
    "ypr": lambda name: entry(name, position=pose(name)[:3, 3].tolist(),
                              ypr_deg=turned(name).as_euler("ZYX", degrees=True).tolist()),
    "a projection": lambda name: {"D": D, "lidar2img": (k_of(name) @ np.linalg.inv(pose(name))[:3]).tolist()},
    "MATLAB": lambda name: {"IntrinsicMatrix": k_of(name).T.tolist(), "ImageSize": [450, 800], "D": D,
                            "T_ego_cam": pose(name).tolist()},
    "RealSense": lambda name: {**dict(zip(("fx", "fy", "ppx", "ppy"), four(name), strict=True)), "D": D,
                               "matrix_world": pose(name).tolist()},
    "axes of Audi's cameras": lambda name: {
        "CamMatrix": k_of(name).tolist(), "Resolution": [800, 450], "Distortion": [D],
        "view": {"origin": pose(name)[:3, 3].tolist(), "x-axis": pose(name)[:3, 2].tolist(),
                 "y-axis": (-pose(name)[:3, 0]).tolist()}},
}  # fmt: skip


@pytest.mark.parametrize(
    ("layout", "spelling"),
    [
        *(("mapping", spelling) for spelling in SPELLINGS),
        ("list", "T_cam_ego"),
        ("rows", "flat"),
        ("folder", "quaternion"),
    ],
)
def test_k_d_and_t_under_their_usual_names(tmp_path, spelling, layout):
    cameras = {name: SPELLINGS[spelling](name) for name in NAMES}
    if layout == "mapping":
        path = written(tmp_path, cameras)
    elif layout != "folder":
        rows = [{"name": name, **each} for name, each in cameras.items()]
        path = written(tmp_path, {"cameras": rows} if layout == "list" else rows, "rig.json")
    else:
        path = {written(tmp_path, each, f"rig/{name}.yaml").parent for name, each in cameras.items()}.pop()
    found = read(path)
    assert_is_the_street(found.rig, lens=True)
    assert found.rig[NAMES[0]].distortion.coefficients == tuple(D)
    [line] = found.notes
    inverted = spelling in ("T_cam_ego", "extrinsics, either way", "rvec and tvec", "a projection")
    direction = "camera_from_ego" if inverted else "ego_from_camera"
    assert re.search(f"{direction}, .*camera axes {'x forward' if 'axes' in spelling else 'x right'}", line)


@pytest.mark.parametrize("suffix", [".yaml", ".xml", ".json"])
def test_files_that_opencv_writes(tmp_path, suffix):
    for name in NAMES:
        path = tmp_path / "rig" / f"{name}{suffix}"
        path.parent.mkdir(exist_ok=True)
        file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        values = {"camera_matrix": k_of(name), "distortion_coefficients": np.array([D]).T, "T": pose(name)}
        for key, value in {**values, "image_width": SIZE[0], "image_height": SIZE[1]}.items():
            file.write(key, value)
        file.release()
    assert_is_the_street(read(tmp_path / "rig", None).rig, lens=True)


@pytest.mark.parametrize(
    ("head", "tail", "message"),
    [('<!DOCTYPE x [<!ENTITY a "b">]>', "", "declares an entity"), ("", "<open>", "broken XML: mismatched tag")],
)
def test_xml_with_entities_or_mistakes_is_refused_in_one_line(head, tail, message, tmp_path):
    (tmp_path / "camera.xml").write_text(f"<?xml version='1.0'?>{head}<opencv_storage>{tail}</opencv_storage>")
    with pytest.raises(InputError, match=message):
        bevcli.read_calibration(tmp_path / "camera.xml")


ORB_SLAM = """%YAML:1.0
Camera.type: "PinHole"
{lines}
T_c_b: {inverse}
"""
VINS = """%YAML:1.0
---
model_type: PINHOLE
camera_name: front
image_width: {size[0]}
image_height: {size[1]}
distortion_parameters: {{k1: -0.1, k2: 0.02, p1: 0.001, p2: -0.002}}
projection_parameters: {{fx: {four[0]}, fy: {four[1]}, cx: {four[2]}, cy: {four[3]}}}
body_T_cam0: !!opencv-matrix {{rows: 4, cols: 4, dt: d, data: {pose}}}
"""


@pytest.mark.parametrize("text", [ORB_SLAM, VINS])
def test_files_of_other_programs_for_one_camera(tmp_path, text):
    name = NAMES[1]
    values = dict(zip(("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"), [*four(name), *D[:4]], strict=True))
    values |= {"width": SIZE[0], "height": SIZE[1]}
    lines = "\n".join(f"Camera.{key}: {value}" for key, value in values.items())
    facts = {"pose": pose(name).ravel().tolist(), "inverse": np.linalg.inv(pose(name)).tolist(), "lines": lines}
    text = text.format(**facts, size=SIZE, four=four(name))
    [camera] = read(written(tmp_path, text, "front.yaml"), None).rig.cameras
    assert camera.name == "front"
    assert (camera.width, camera.height) == SIZE
    assert camera.distortion.coefficients == tuple(D[:4])
    np.testing.assert_allclose(camera.intrinsics, k_of(name))
    np.testing.assert_allclose(camera.ego_from_camera, pose(name), atol=1e-9)


def colmap(folder, poses):
    """cameras.txt and images.txt. poses: of each camera, a list of camera_from_world."""
    lines, images = ["# Camera list"], ["# Image list"]
    for key, name in enumerate(NAMES, 1):
        k = k_of(name)
        numbers = (k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, *D[:4])
        lines.append(" ".join(map(str, (key, "OPENCV", *SIZE, *numbers))))
        for number, matrix in enumerate(poses[name]):
            x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
            images.append(" ".join(map(str, (number, w, x, y, z, *matrix[:3, 3], key, f"{name}/{number:06d}.jpg"))))
            images.append("1.5 2.5 1 3.5 4.5 -1 5.5 6.5 2 7.5" if number else "")
    written(folder, "\n".join(lines), "sparse/0/cameras.txt")
    written(folder, "\n".join(images), "sparse/0/images.txt")
    return folder


def test_colmap(tmp_path):
    found = read(colmap(tmp_path, {name: [np.linalg.inv(pose(name))] * 2 for name in NAMES}))
    assert_is_the_street(found.rig, lens=True)
    assert "camera_from_ego" in found.notes[0]
    # A reconstruction of a drive has no poses on the vehicle.
    folder = colmap(tmp_path, {name: [np.linalg.inv(pose(name)), np.eye(4)] for name in NAMES})
    with pytest.raises(InputError, match=r"moves through the file.*`--extrinsics FILE`"):
        read(folder)
    poses = written(tmp_path, {name: {"ego_from_camera": pose(name).tolist()} for name in NAMES}, "poses.json")
    assert_is_the_street(read(folder, extrinsics=poses).rig, lens=True)


@pytest.mark.parametrize("tracking", [False, True])
def test_kitti(tmp_path, tracking):
    """The drawing of the vehicle: cameras 1.65 m above the road; the Velodyne 1.73 m, and 0.27 m behind them."""
    k = np.array([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]])
    rows = {"P2": k @ np.c_[np.eye(3), [0.06, 0, 0]], "R0_rect": np.eye(3)}
    rows["Tr_velo_to_cam"] = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27]])
    text = lines_of(rows)
    if tracking:
        text = text.replace("R0_rect:", "R_rect").replace("Tr_velo_to_cam:", "Tr_velo_cam")
    path = written(tmp_path, text, "000000.txt")
    images = tmp_path / "images" / "image_2"
    images.mkdir(parents=True)
    cv2.imwrite(str(images / "0.png"), np.zeros((375, 1242, 3), np.uint8))
    [camera] = read(path, tmp_path).rig.cameras
    assert (camera.width, camera.height) == (1242, 375)
    np.testing.assert_allclose(camera.intrinsics, k)
    np.testing.assert_allclose(camera.ego_from_camera[:3, 3], [0.76 + 0.27, 0.06, 1.65], atol=1e-9)
    np.testing.assert_allclose(camera.ego_from_camera[:3, 2], [1, 0, 0], atol=1e-9)


MIRRORS = [np.diag([-1.0, 1, 1]), np.diag([1.0, -1, 1]), np.diag([-1.0, -1, -1])]


@pytest.mark.parametrize("mirror", MIRRORS, ids=["x", "y", "all"])
@pytest.mark.parametrize("kind", ["T_ego_cam", "T_cam_ego", "T", "R and t", "chain", "nerfstudio", "KITTI", "own"])
def test_a_matrix_that_mirrors_is_no_rotation(tmp_path, kind, mirror):
    name, mirrored = NAMES[0], np.eye(4)
    matrix = pose(name)
    mirrored[:3, :3] = mirror
    if kind.startswith("T"):
        stated = np.linalg.inv(matrix) if kind == "T_cam_ego" else matrix
        path = written(tmp_path, {"front": entry(name, **{kind: (stated @ mirrored).tolist()})})
    elif kind == "R and t":
        extrinsics = {"translation": matrix[:3, 3].tolist(), "rotation": (matrix[:3, :3] @ mirror).tolist()}
        path = written(tmp_path, {"front": entry(name, extrinsics=extrinsics)})
    elif kind == "chain":
        chain = {"cam0": entry(name, T_ego_cam=matrix.tolist()), "cam1": entry(name, T_cn_cnm1=mirrored.tolist())}
        path = written(tmp_path, chain)
    elif kind == "nerfstudio":
        frame = {"file_path": "images/a/0.jpg", "transform_matrix": (pose(name, axes=OPENGL) @ mirrored).tolist()}
        numbers = dict(zip(("fl_x", "fl_y", "cx", "cy"), four(name), strict=True))
        path = written(tmp_path, {"w": SIZE[0], "h": SIZE[1], **numbers, "frames": [frame]}, "transforms.json")
    elif kind == "KITTI":
        camera_from_velodyne = np.c_[mirror @ [[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], [0, -0.08, -0.27]]
        rows = {"P_rect_02": np.c_[k_of(name), [0, 0, 0]], "S_rect_02": SIZE, "Tr_velo_to_cam": camera_from_velodyne}
        path = written(tmp_path, lines_of(rows), "calib_cam_to_cam.txt")
    else:
        rotation = {"translation": matrix[:3, 3].tolist(), "rotation": (matrix[:3, :3] @ mirror).tolist()}
        camera = {**FACTS[name], "ego_from_camera": rotation}
        path = written(tmp_path, {"format": "bevcli-calibration/1", "cameras": {name: camera}}, "calibration.json")
    with pytest.raises(InputError, match=r"mirror|left-handed|not upright|determinant"):
        read(path, None)


def test_a_name_twice_is_named_in_every_calibration(tmp_path):
    one = "<K>1 2</K>"
    for file, text, twice in (
        ("rig.xml", f"<opencv_storage>{one}{one}</opencv_storage>", '"K" appears twice in <opencv_storage>'),
        ("cameras.txt", "1 PINHOLE 8 4 5 5 4 2\n1 PINHOLE 8 4 6 5 4 2\n", "line 2: camera 1 is in the file twice"),
        ("calib.txt", "P2: 1 2\nP2: 1 3\n", "line 2: P2 is in the file twice"),
        ("rig.json", '{"a": {"K": 1}, "a": {"K": 2}}', '"a" appears twice in the same object'),
    ):
        with pytest.raises(InputError, match=re.escape(twice)):
            read(written(tmp_path, text, file), None)


@pytest.mark.parametrize("kind", ["folder", "list", "mapping", "xml"])
def test_a_rig_without_cameras_is_one_line(tmp_path, kind):
    if kind == "folder":
        path = tmp_path / "rig"
        (path / "x.yaml").mkdir(parents=True)
    else:
        texts = {"list": ("r.json", "[]"), "mapping": ("r.yaml", "cameras: {}"), "xml": ("r.xml", "<a><cameras/></a>")}
        path = written(tmp_path, texts[kind][1], texts[kind][0])
    with pytest.raises(
        InputError, match=r"has no camera|contains no camera|no mapping|is not a (JSON object|regular file)"
    ):
        read(path, None)
    with pytest.raises(InputError):
        bevcli.open_sequence(STREET, calibration=path)


def lines_of(rows):
    return "".join(f"{key}: {' '.join(map(str, np.ravel(value)))}\n" for key, value in rows.items())


def test_a_field_of_view_a_height_and_a_yaw_make_a_rig(tmp_path):
    yaws = {name: 60.0 * place for place, name in enumerate(NAMES)}
    rig = draft_of(RigOptions(fov_deg=90, height=dict.fromkeys(NAMES, 1.5), yaw_deg=yaws), STREET).rig
    for name in NAMES:
        camera, angle = rig[name], np.radians(yaws[name])
        ahead = camera.ego_from_camera[:3, 3] + [10 * np.cos(angle), 10 * np.sin(angle), 0]
        side = ahead + [-10 * np.sin(angle), 10 * np.cos(angle), 0]  # 45 degrees to the left: the edge of the image
        pixels, _ = camera.project_ego([ahead, side])
        np.testing.assert_allclose(
            pixels, [[(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2], [-0.5, (SIZE[1] - 1) / 2]], atol=1e-6
        )
        assert camera.ego_from_camera[2, 3] == 1.5


def test_a_direction_that_is_not_certain_is_asked(tmp_path):
    """The rotation of a camera that looks to the right is its own inverse, and both heights are possible here."""
    matrix = np.array([[-1.0, 0, 0, 1.2], [0, 0, -1, 1.0], [0, -1, 0, 1.5], [0, 0, 0, 1]])
    stated = {"K": k_of(NAMES[0]).tolist(), "T": matrix.tolist(), "width": SIZE[0], "height": SIZE[1]}
    path = written(tmp_path, {"side": stated})
    with pytest.raises(InputError, match=r"no images decide .*`--transform ego_from_camera.*--transform camera_from"):
        bevcli.read_calibration(path, rig_axes="flu", camera_axes="optical")
    for direction, expected in (("ego_from_camera", matrix), ("camera_from_ego", np.linalg.inv(matrix))):
        found = bevcli.read_calibration(path, transform=direction, rig_axes="flu", camera_axes="optical")
        np.testing.assert_allclose(found["side"].ego_from_camera, expected)


def test_every_reading_that_is_named_can_be_stated(tmp_path):
    """The readings of a camera whose name says nothing, each by the options that the error names."""
    path = written(tmp_path, {"eye": entry(NAMES[0], T=pose(NAMES[0]).tolist(), resolution=list(SIZE))})
    with pytest.raises(InputError) as asked:
        bevcli.read_calibration(path, STREET)
    choices = re.findall("`(--[^`]*)`", str(asked.value))
    assert len(choices) > 1
    for choice in choices:
        words = choice.split()
        stated = {flag[2:].replace("-", "_"): value for flag, value in zip(words[::2], words[1::2], strict=True)}
        assert [each.rank for each in read(path, **stated).readings].count(0) == 1


def test_a_height_moves_a_rig_whose_origin_is_not_on_the_ground(tmp_path):
    lowered = {name: pose(name) for name in NAMES}
    for matrix in lowered.values():
        matrix[2, 3] -= 1.84
    path = written(tmp_path, {name: entry(name, T=lowered[name].tolist()) for name in NAMES})
    heights = {name: float(pose(name)[2, 3]) for name in NAMES}
    assert_is_the_street(read(path, height=heights).rig, lens=True)


def scaled(matrix, factors):
    return [(np.array(row) * factors).tolist() for row in matrix[:3]]


@pytest.mark.parametrize("seed", range(2))
def test_drawn_rigs_are_among_the_readings_both_ways(tmp_path, seed):
    """A whole rig under a name that states nothing; each camera alone under one that states the direction."""
    cameras = draw_rig(RigDistribution(), seed, SIZE).rig.cameras
    assert_among_the_readings(tmp_path, cameras)


def test_real_rigs_are_among_the_readings_both_ways(shared, tmp_path):
    for drive in ("nuscenes-scene-0103", "kitti-straight", "dgp-scene_01"):
        sequence = bevcli.open_sequence(shared / "data" / drive, ego_motion="optional", ground_truth=False)
        assert_among_the_readings(tmp_path, sequence.rig.cameras)


def assert_among_the_readings(folder, cameras):
    for rig in (cameras, *((camera,) for camera in cameras[:2])):
        for name, stated in (("T_ego_cam", np.array), ("T_cam_ego", np.linalg.inv)):
            key = name if len(rig) == 1 else "T"
            entries = {
                camera.name: {
                    "K": camera.intrinsics.tolist(), key: stated(camera.ego_from_camera).tolist(),
                    "resolution": [camera.width, camera.height],
                }
                for camera in rig
            }  # fmt: skip
            truth = {camera.name: camera.ego_from_camera for camera in rig}
            readings = read(written(folder, entries, "rig.json"), None).readings
            assert any(
                all(np.allclose(each.ego_from_camera[name], truth[name], atol=1e-9) for name in truth)
                for each in readings
            )


MISTAKES = {
    "no pose": (lambda e: e.pop("T"), "its pose .T, extrinsics.*is missing.*`height` .* and `yaw_deg`"),
    "no intrinsics": (lambda e: e.pop("K"), "has no intrinsics"),
    "lens": (lambda e: e.update(distortion_model="cata"), "distortion_model cata is not supported"),
    "millimetres": (lambda e: e.update(T=scaled(e["T"], [1, 1, 1, 1000])), "in millimetres"),
    "two numbers": (lambda e: e.update(T=[1, 2]), "T: is not understood as a transform"),
    "rotation": (lambda e: e.update(T=scaled(e["T"], [1.1, 1, 1, 1])), "T: the rotation is not orthonormal"),
    "upside down": (lambda e: e.update(T=(np.array(e["T"]) @ np.diag([-1, -1, 1, 1])).tolist()), "not upright"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line_that_names_file_and_camera(tmp_path, mistake):
    spoil, expected = MISTAKES[mistake]
    cameras = {name: entry(name, T=pose(name).tolist()) for name in NAMES}
    spoil(cameras[NAMES[1]])
    path = written(tmp_path, cameras)
    with pytest.raises(InputError, match=expected) as caught:
        read(path)
    line = str(caught.value)
    assert line.startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("how", "expected"),
    [
        ({"fov_deg": 70}, "needs the height"),
        ({"height": 1.5}, "needs a field of view or a calibration"),
        ({"rig_axes": "frd"}, "`rig_axes` .`--rig-axes`. needs a field of view"),
        ({"fov_deg": 70, "height": 1.5}, "directions of 6 cameras are not stated"),
        ({"fov_deg": 70, "height": 1.5, "yaw_deg": 0}, "one direction for 6 cameras"),
        ({"fov_deg": 70, "height": 1.5, "yaw_deg": {"front": 0}}, "there is no camera front"),
        ({"fov_deg": 0, "height": 1.5, "yaw_deg": dict.fromkeys(NAMES, 0)}, "5 to 170"),
        ({"fov_deg": 70, "height": 150, "yaw_deg": dict.fromkeys(NAMES, 0)}, "metres above the ground"),
    ],
)
def test_numbers_that_are_missing_or_wrong_are_named(how, expected):
    with pytest.raises(InputError, match=expected):
        draft_of(RigOptions(**how), STREET)


def test_a_size_that_nothing_states_is_missing(tmp_path):
    path = written(tmp_path, {name: entry(name, T=pose(name).tolist()) for name in NAMES})
    with pytest.raises(InputError, match=re.escape(f"camera {NAMES[0]}: the image size is missing")):
        read(path, None)


def test_cameras_and_sizes_are_found_where_the_images_lie(tmp_path):
    image = cv2.imencode(".jpg", np.zeros((36, 64, 3), np.uint8))[1].tobytes()
    for folder, path in (("a", "images/front/7.jpg"), ("b", "front/7.jpg"), ("c", "rgb/7.jpg")):
        file = tmp_path / folder / path
        file.parent.mkdir(parents=True)
        file.write_bytes(image)
    (tmp_path / "c/frames.csv").write_text("frame,timestamp_ns,front\n0,1,\n1,2,rgb/7.jpg\n")
    for folder in "abc":
        [camera] = draft_of(RigOptions(fov_deg=90, height=1.5), tmp_path / folder).rig.cameras
        assert (camera.name, camera.width, camera.height) == ("front", 64, 36)
        np.testing.assert_allclose(camera.intrinsics, [[32, 0, 31.5], [0, 32, 17.5], [0, 0, 1]])


def test_a_size_is_that_of_a_folder_with_a_similar_name(tmp_path):
    """front is CAM_FRONT."""
    cameras = {name: {"K": k_of(name).tolist(), "T": pose(name).tolist()} for name in NAMES}
    for name in NAMES:
        folder = tmp_path / "drive" / name.removeprefix("CAM_").lower()
        folder.mkdir(parents=True)
        (folder / "0.jpg").write_bytes((STREET / f"images/{name}/000000.jpg").read_bytes())
    assert_is_the_street(read(written(tmp_path, cameras), tmp_path / "drive").rig)
