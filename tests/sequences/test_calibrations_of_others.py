"""Calibrations as other programs write them: made here, read, and compared with the rig of samples/street."""

import json
import pickle
import re

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from test_calibrations import NAMES, OPENGL, SIZE, VEHICLE, D, assert_is_the_street, four, k_of, pose, read, written

from bevcli.errors import InputError
from bevcli.sequences.files.calibration_file import draft_of
from bevcli.sequences.options import RigOptions

EGO_FROM_LIDAR = np.array([[0.0, 1, 0, 0.94], [-1, 0, 0, 0], [0, 0, 1, 1.84], [0, 0, 0, 1]])  # x right, y forward


def wxyz(matrix):
    return np.roll(Rotation.from_matrix(matrix[:3, :3]).as_quat(), 1).tolist()


def bevdet(name):
    lidar = np.linalg.inv(EGO_FROM_LIDAR) @ pose(name)
    return {
        "data_path": f"samples/{name}/0.jpg", "type": name, "timestamp": 1533151603512404, "cam_intrinsic": k_of(name),
        "sensor2ego_translation": pose(name)[:3, 3].tolist(), "sensor2ego_rotation": wxyz(pose(name)),
        "sensor2lidar_rotation": lidar[:3, :3], "sensor2lidar_translation": lidar[:3, 3],
    }  # fmt: skip


def without(camera, *words):
    return {key: value for key, value in camera.items() if not any(word in key for word in words)}


def lidar2cam(name):
    return np.linalg.inv(pose(name)) @ EGO_FROM_LIDAR


LIDAR2EGO = {
    "lidar2ego_translation": EGO_FROM_LIDAR[:3, 3].tolist(), "lidar2ego_rotation": wxyz(EGO_FROM_LIDAR),
}  # fmt: skip
INFORMATION = {
    "sensor2ego": [{"token": "a", "cams": {name: bevdet(name) for name in NAMES}, **LIDAR2EGO}] * 2,
    "sensor2lidar": [{"cams": {name: without(bevdet(name), "sensor2ego") for name in NAMES}, **LIDAR2EGO}],
    "cam2ego": [{"images": {name: {"cam2img": k_of(name), "cam2ego": pose(name)} for name in NAMES}}],
    "lidar2cam": [
        {
            "images": {name: {"cam2img": k_of(name), "lidar2cam": lidar2cam(name)} for name in NAMES},
            "lidar_points": {"lidar2ego": EGO_FROM_LIDAR},
        }
    ],
}


@pytest.mark.parametrize("names", INFORMATION)
@pytest.mark.parametrize("form", [0, 2, 4, 5, "json"])
def test_information_files_of_bevdet_and_mmdetection3d(tmp_path, names, form):
    key = "data_list" if names in ("lidar2cam", "cam2ego") else "infos"
    document = {key: INFORMATION[names], "metadata": {"version": "v1.0-mini"}}
    path = tmp_path / f"nuscenes_infos_val.{'json' if form == 'json' else 'pkl'}"
    if form != "json":  # the protocol of a pickle
        path.write_bytes(pickle.dumps(document, protocol=form))
    else:
        path.write_text(json.dumps(document, default=lambda array: array.tolist()))
    found = read(path)
    assert_is_the_street(found.rig)
    assert "poses as stated" in found.notes[0]


class Attack:
    def __reduce__(self):
        return print, ("called",)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        (Attack(), r"it calls builtins.print, and was not read further"),
        ([], "has no entries"),
        ([{"token": 1}], 'entry 0: has no cameras \\(expected "cams" or "images"'),
        ([{"cams": {"A": {"sensor2ego_translation": [0, 0, 0]}}}], "entry 0: camera A: has no intrinsics"),
        ([{"cams": {"A": {"cam_intrinsic": [1, 2]}}}], "camera A: cam_intrinsic: expected 3x3 or 4x4"),
        ([{"cams": {"A": {**bevdet(NAMES[0]), "cam_intrinsic": k_of(name)}}} for name in NAMES[2:4]],
         "entry 1 has another rig than entry 0: keep those of this drive"),
    ],
)  # fmt: skip
def test_a_mistake_in_an_information_file_is_one_line(tmp_path, entries, message, capsys):
    path = tmp_path / "infos.pkl"
    path.write_bytes(pickle.dumps({"infos": entries}))
    with pytest.raises(InputError, match=message):
        read(path)
    path.write_bytes(pickle.dumps({"infos": entries})[:20])
    with pytest.raises(InputError, match="cannot be read as a pickle"):
        read(path)
    path.write_bytes(b"\x80\x04Nr\xff\xff\xff\x7f.")  # a memo of 2 billion places
    with pytest.raises(InputError, match="it is damaged"):
        read(path)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("layout", ["list", "context"])
def test_nine_intrinsics_of_waymo(tmp_path, layout):
    cameras = [
        {
            "name": name, "intrinsic": [*four(name), *D], "width": SIZE[0], "height": SIZE[1],
            "extrinsic": {"transform": pose(name, axes=VEHICLE).ravel().tolist()},
        }
        for name in NAMES
    ]  # fmt: skip
    path = written(tmp_path, cameras if layout == "list" else {"cameraCalibrations": cameras}, "context.json")
    found = read(path, None)
    assert_is_the_street(found.rig, lens=True)
    assert found.rig[NAMES[0]].distortion.coefficients == tuple(D)


def pinhole(name, model="PINHOLE"):
    numbers = dict(zip(("fx", "fy", "cx", "cy"), four(name), strict=True))
    lens = {"distortion_parameters": dict(zip(("k1", "k2", "p1", "p2"), D[:4], strict=True))}
    if model == "KANNALA_BRANDT":
        numbers = dict(zip(("mu", "mv", "u0", "v0"), four(name), strict=True))
        numbers, lens = {"k2": D[0], "k3": D[1], "k4": D[2], "k5": D[3], **numbers}, {}
    facts = {"model_type": model, "camera_name": "camera", "image_width": SIZE[0], "image_height": SIZE[1]}
    return "%YAML:1.0\n---\n" + yaml.safe_dump({**facts, **lens, "projection_parameters": numbers})


@pytest.mark.parametrize("model", ["PINHOLE", "KANNALA_BRANDT"])
@pytest.mark.parametrize("part", ["folder", "file"])
def test_the_folder_of_vins_fusion(tmp_path, model, part):
    lines = ["%YAML:1.0", "", "#common parameters", "imu: 1", "num_of_cam: 6", 'output_path: "~/output/"']
    for index, name in enumerate(sorted(NAMES)):
        written(tmp_path, pinhole(name, model), f"config/cam{index}.yaml")
        data = ", ".join(map(str, pose(name).ravel()))
        lines += [f'cam{index}_calib: "cam{index}.yaml"', f"body_T_cam{index}: !!opencv-matrix",
                  "   rows: 4", "   cols: 4", "   dt: d", f"   data: [{data}]", ""]  # fmt: skip
    main = written(tmp_path, "\n".join(lines), "config/stereo_config.yaml")
    found = read(main.parent if part == "folder" else main, None)
    assert_is_the_street(found.rig, [f"cam{index}" for index in range(len(NAMES))], lens=True)
    assert found.rig["cam0"].distortion.model == ("brown_conrady" if model == "PINHOLE" else "kannala_brandt")
    (main.parent / "cam3.yaml").unlink()
    with pytest.raises(InputError, match=r"cam3\.yaml: the file is missing"):
        read(main)


def frame(matrix):
    angles = Rotation.from_matrix(matrix[:3, :3]).as_euler("ZYX")
    values = map(float, [*matrix[:3, 3], *angles])
    return dict(zip(("x", "y", "z", "yaw", "pitch", "roll"), values, strict=True))


BASE_FROM_KIT = np.eye(4)
BASE_FROM_KIT[:3, :3] = Rotation.from_euler("ZYX", [0.4, 0.05, -0.02]).as_matrix()
BASE_FROM_KIT[:3, 3] = 0.9, 0.1, 2.0


@pytest.mark.parametrize("frames", ["camera_link", "camera_optical_link", "both"])
def test_frames_of_autoware(tmp_path, frames):
    """The cameras are placed on a kit of sensors, and the kit on the vehicle; K is in a file for each camera."""
    from_kit, names = np.linalg.inv(BASE_FROM_KIT), ("camera_link", "camera_optical_link")
    kit = {"velodyne_top_base_link": frame(np.eye(4))}
    for name in NAMES:
        bodies = {"camera_link": pose(name, axes=VEHICLE), "camera_optical_link": pose(name)}
        kit |= {f"{name}/{each}": frame(from_kit @ bodies[each]) for each in names if frames in (each, "both")}
        info = {"camera_name": name, "image_width": SIZE[0], "image_height": SIZE[1]}
        info["camera_matrix"] = k_of(name).tolist()
        written(tmp_path, info, f"intrinsics/{name}.yaml")
    path = written(tmp_path, {"sensor_kit_base_link": kit}, "sensor_kit_calibration.yaml")
    written(tmp_path, {"base_link": {"sensor_kit_base_link": frame(BASE_FROM_KIT)}}, "sensors_calibration.yaml")
    assert_is_the_street(read(tmp_path / "intrinsics", None, extrinsics=path).rig)


def test_joints_of_a_urdf(tmp_path):
    """A joint to the body of each camera, and one from there to its optical frame."""
    joints = []
    for name in NAMES:
        place = frame(pose(name, axes=VEHICLE))
        xyz, rpy = (" ".join(str(place[key]) for key in keys) for keys in (("x", "y", "z"), ("roll", "pitch", "yaw")))
        joints.append(
            f'<joint name="{name}" type="fixed"><origin xyz="{xyz}" rpy="{rpy}"/><parent link="base_link"/>'
            f'<child link="{name}_link"/></joint><joint name="{name}_optical" type="fixed"><parent link="{name}_link"/>'
            f'<origin rpy="-1.5707963267948966 0 -1.5707963267948966"/><child link="{name}_optical_frame"/></joint>'
        )
    path = written(tmp_path, f'<robot name="car">{"".join(joints)}</robot>', "car.urdf")
    intrinsics = written(
        tmp_path, {name: {"K": k_of(name).tolist(), "width": SIZE[0], "height": SIZE[1]} for name in NAMES}
    )
    assert_is_the_street(read(intrinsics, None, extrinsics=path).rig)


def stamped(frame, parent, matrix):
    """geometry_msgs/TransformStamped."""
    turn = dict(zip("xyzw", Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist(), strict=True))
    placed = {"rotation": turn, "translation": dict(zip("xyz", matrix[:3, 3].tolist(), strict=True))}
    return {"header": {"frame_id": parent}, "child_frame_id": frame, "transform": placed}


@pytest.mark.parametrize("program", ["tf_static", "Apollo"])
def test_frames_as_messages_of_ros(tmp_path, program):
    """All in one dump; or one a file, as Apollo has them, the cameras on the lidar and this on the receiver."""
    ending = "_optical_frame" if program == "tf_static" else ""
    frames = [stamped(name + ending, "lidar" if program == "Apollo" else "base_link", pose(name)) for name in NAMES]
    frames.append(stamped("lidar", "novatel", np.eye(4)))
    for name in NAMES:
        intrinsics = {"K": k_of(name).ravel().tolist(), "width": SIZE[0], "height": SIZE[1]}
        folder = written(tmp_path, intrinsics, f"intrinsics/{name}_intrinsics.yaml").parent
    for each in frames if program == "Apollo" else ():
        extrinsics = written(tmp_path, each, f"extrinsics/{each['child_frame_id']}_extrinsics.yaml").parent
    if program == "tf_static":
        extrinsics = written(tmp_path, {"transforms": frames}, "tf/tf.yaml")
    assert_is_the_street(read(folder, None, extrinsics=extrinsics).rig)


def of_basalt(names):
    turns = [Rotation.from_matrix(pose(name)[:3, :3]).as_quat().tolist() for name in names]
    lists = {
        "T_imu_cam": [dict(zip(("px", "py", "pz", "qx", "qy", "qz", "qw"), (*pose(name)[:3, 3].tolist(), *turn),
                               strict=True)) for name, turn in zip(names, turns, strict=True)],
        "intrinsics": [{"camera_type": "pinhole", "intrinsics": dict(
            zip(("fx", "fy", "cx", "cy"), four(name), strict=True))} for name in names],
        "resolution": [list(SIZE)] * len(names),
    }  # fmt: skip
    return {"value0": lists}


def of_argoverse(names):
    keys = [f"focal_{kind}_{axis}_px_" for kind in ("length", "center") for axis in "xy"]
    return {"camera_data_": [{"key": name, "value": {
        **dict(zip(keys, four(name), strict=True)),
        "vehicle_SE3_camera_": {"rotation": {"coefficients": wxyz(pose(name))},
                                "translation": pose(name)[:3, 3].tolist()},
    }} for name in names]}  # fmt: skip


def of_once(names):
    inside = {name: {"cam_to_velo": pose(name).tolist(), "cam_intrinsic": k_of(name).tolist()} for name in names}
    return {"meta": {"weather": "sunny"}, "calib": inside}


@pytest.mark.parametrize("written_by", [of_basalt, of_argoverse, of_once])
def test_lists_and_inner_mappings_of_cameras(tmp_path, written_by):
    names = [f"cam{index}" for index in range(len(NAMES))] if written_by is of_basalt else NAMES
    assert_is_the_street(read(written(tmp_path, written_by(sorted(NAMES)), "calibration.json")).rig, names)


@pytest.mark.parametrize("program", ["COLMAP", "nerfstudio"])
@pytest.mark.parametrize("layout", ["one image of each camera", "a folder of each camera"])
def test_a_camera_an_image(tmp_path, program, layout):
    """COLMAP's default states a camera for each image, and so may nerfstudio."""
    count = 1 if layout.startswith("one") else 3
    images = [(name, f"{name}.jpg" if count == 1 else f"{name}/{index}.jpg", 1 + index * 1e-4)
              for name in NAMES for index in range(count)]  # fmt: skip
    lines, poses, frames = [], [], []
    for number, (name, file, factor) in enumerate(images, 1):
        fx, fy, cx, cy = np.array(four(name)) * [factor, factor, 1, 1] + [0, 0, 0.5, 0.5]
        lines.append(" ".join(map(str, (number, "OPENCV", *SIZE, fx, fy, cx, cy, *D[:4]))))
        matrix = np.linalg.inv(pose(name))
        poses += [" ".join(map(str, (number, *wxyz(matrix), *matrix[:3, 3], number, file))), ""]
        frame = dict(zip(("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"), [fx, fy, cx, cy, *D], strict=False))
        frames.append({"file_path": f"images/{file}", "transform_matrix": pose(name, axes=OPENGL).tolist(), **frame})
    document = {"camera_model": "OPENCV", "w": SIZE[0], "h": SIZE[1], "frames": frames}
    if program == "COLMAP":
        written(tmp_path, "\n".join(lines), "cameras.txt")
        path = written(tmp_path, "\n".join(poses), "images.txt").parent
    else:
        path = written(tmp_path, document, "transforms.json")
    found = read(path)
    assert sorted(found.rig.names) == sorted(NAMES)
    for name in NAMES:
        np.testing.assert_allclose(found.rig[name].ego_from_camera, pose(name), atol=1e-5)
        np.testing.assert_allclose(found.rig[name].intrinsics, k_of(name), rtol=2e-4)
    if count > 1:
        if program == "COLMAP":
            lines[1] = lines[1].replace("OPENCV 800 450 63", "OPENCV 800 450 75")
            written(tmp_path, "\n".join(lines), "cameras.txt")
        else:
            frames[1]["fl_x"] *= 1.2
            written(tmp_path, document, "transforms.json")
        with pytest.raises(InputError, match=f"{NAMES[0]}: its images have focal lengths of 633 to 7"):
            read(path)


def test_four_coefficients_without_a_lens_are_noted_and_the_other_is_stated(tmp_path):
    """cv2.fisheye.calibrate writes four numbers, too. The advice of the note is followed."""
    cameras = {name: {"K": k_of(name).tolist(), "D": [[0.02], [0.004], [-0.003], [0.001]],
                      "ego_from_camera": pose(name).tolist()} for name in NAMES}  # fmt: skip
    found = read(written(tmp_path, cameras, "rig.json"))
    assert found.rig[NAMES[0]].distortion.model == "brown_conrady"
    assert "are taken as k1, k2, p1, p2; if they are k1 to k4 of a fisheye" in found.notes[1]
    assert "state distortion_model: fisheye beside them" in found.notes[1]
    stated = {name: {**camera, "distortion_model": "fisheye"} for name, camera in cameras.items()}
    for each in (stated, {name: {**without(camera, "D"), "k1": 0.02, "k2": 0.004, "k3": -0.003, "k4": 0.001}
                          for name, camera in cameras.items()}):  # fmt: skip
        found = read(written(tmp_path, each, "rig.json"))
        assert found.rig[NAMES[0]].distortion.model == "kannala_brandt"
        assert found.rig[NAMES[0]].distortion.coefficients == (0.02, 0.004, -0.003, 0.001)
        assert len(found.notes) == 1


@pytest.mark.parametrize("lens", ["PinHole", "KannalaBrandt8"])
def test_two_cameras_of_orb_slam(tmp_path, lens):
    """The first camera is placed on the IMU, and the second from the first."""
    left, right = NAMES[0], NAMES[1]
    names = ("k1", "k2", "p1", "p2") if lens == "PinHole" else ("k1", "k2", "k3", "k4")
    lines = ["%YAML:1.0", 'File.version: "1.0"', f'Camera.type: "{lens}"', f"Camera.width: {SIZE[0]}"]
    lines.append(f"Camera.height: {SIZE[1]}")
    for number, name in ((1, left), (2, right)):
        values = dict(zip(("fx", "fy", "cx", "cy", *names), [*four(name), *D[:4]], strict=True))
        lines += [f"Camera{number}.{key}: {value}" for key, value in values.items()]
    for key, matrix in (("IMU.T_b_c1", pose(left)), ("Stereo.T_c1_c2", np.linalg.inv(pose(left)) @ pose(right))):
        data = ", ".join(map(str, matrix.ravel()))
        lines.append(f"{key}: !!opencv-matrix\n  rows: 4\n  cols: 4\n  dt: f\n  data: [{data}]")
    found = read(written(tmp_path, "\n".join(lines), "stereo.yaml"), None).rig
    for camera, name in (("Camera1", left), ("Camera2", right)):
        np.testing.assert_allclose(found[camera].ego_from_camera, pose(name), atol=1e-6)
        np.testing.assert_allclose(found[camera].intrinsics, k_of(name))
        assert found[camera].distortion.model == ("brown_conrady" if lens == "PinHole" else "kannala_brandt")


def test_the_folder_of_euroc(tmp_path):
    for index, name in enumerate(sorted(NAMES)):
        camera = {"sensor_type": "camera", "T_BS": {"cols": 4, "rows": 4, "data": pose(name).ravel().tolist()},
                  "resolution": list(SIZE), "camera_model": "pinhole", "intrinsics": four(name),
                  "distortion_model": "radial-tangential", "distortion_coefficients": D[:4]}  # fmt: skip
        written(tmp_path, camera, f"mav0/cam{index}/sensor.yaml")
    written(tmp_path, {"sensor_type": "imu", "rate_hz": 200}, "mav0/imu0/sensor.yaml")
    found = read(tmp_path / "mav0", None)
    assert_is_the_street(found.rig, [f"cam{index}" for index in range(len(NAMES))], lens=True)


@pytest.mark.parametrize("layout", ["agent", "objects.json"])
def test_the_sensors_of_carla(tmp_path, layout):
    """In an agent y is right and a positive yaw looks to the right; the ROS bridge has ROS's axes."""
    is_ros = layout == "objects.json"
    sensors = [{"type": "sensor.lidar.ray_cast", "id": "lidar", "x": 0, "y": 0, "z": 2}]
    for name in NAMES:
        place = {key: np.degrees(value) if key in ("roll", "pitch", "yaw") else value
                 for key, value in frame(pose(name, axes=VEHICLE)).items()}  # fmt: skip
        sides = ("y", "pitch", "yaw")
        place = {key: value if is_ros or key not in sides else -value for key, value in place.items()}
        fov = float(np.degrees(2 * np.arctan(SIZE[0] / 2 / k_of(name)[0, 0])))
        facts = {"type": "sensor.camera.rgb", "id": name, "fov": fov}
        size = dict(zip(("image_size_x", "image_size_y") if is_ros else ("width", "height"), SIZE, strict=True))
        sensors.append({**facts, **size, **({"spawn_point": place} if is_ros else place)})
    document = {"objects": [{"type": "vehicle.tesla.model3", "id": "ego", "sensors": sensors}]} if is_ros else sensors
    found = read(written(tmp_path, document, "objects.json"), None)
    assert sorted(found.rig.names) == sorted(NAMES)
    for name in NAMES:
        np.testing.assert_allclose(found.rig[name].ego_from_camera, pose(name), atol=1e-6)
        np.testing.assert_allclose(found.rig[name].intrinsics[:2, :2], k_of(name)[:2, :2], rtol=1e-6)
        np.testing.assert_allclose(found.rig[name].intrinsics[:2, 2], (np.array(SIZE) - 1) / 2)
    sensors[1]["fov"] = "wide"
    with pytest.raises(InputError, match=f"camera {NAMES[0]}: expected numbers for x, y, z, roll, pitch, yaw"):
        read(written(tmp_path, document, "objects.json"), None)


KALIBR = """
cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.7e-05]
  distortion_model: radtan
  intrinsics: [458.6, 457.3, 367.2, 248.4]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.02]
  - [0.0, 0.0, 1.0, 0.03]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.01, 0.02, 0.03, 0.04]
  distortion_model: equidistant
  intrinsics: [457.5, 456.1, 379.9, 255.2]
  resolution: [752, 480]
"""
ROS = """
image_width: 640
image_height: 480
camera_name: narrow
camera_matrix: {rows: 3, cols: 3, data: [500.0, 0, 320, 0, 501.0, 240, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 0.001, 0.002, 0.03]}
"""
ROS_MESSAGE = """
header: {frame_id: wide}
height: 480
width: 640
distortion_model: rational_polynomial
d: [0.1, 0.2, 0.0, 0.0, 0.1, 0.1, 0.1, 0.1]
k: [500.0, 0, 320, 0, 501.0, 240, 0, 0, 1]
"""
POSE = {"translation": [1.5, 0.0, 1.4], "rotation_wxyz": [0.5, -0.5, 0.5, -0.5]}


def read_rig(intrinsics, extrinsics):
    return draft_of(RigOptions(intrinsics=intrinsics, extrinsics=extrinsics)).rig


def write(folder, text, poses, name="intrinsics.yaml", **more):
    (folder / name).write_text(text)
    cameras = {camera: {"ego_from_camera": pose} for camera, pose in poses.items()}
    (folder / "extrinsics.json").write_text(json.dumps({"cameras": cameras, **more}))
    return folder / name, folder / "extrinsics.json"


def test_kalibr(tmp_path):
    rig = read_rig(*write(tmp_path, KALIBR, {"cam0": POSE, "cam1": POSE}, ego_from_bev=POSE))
    assert rig.names == ("cam0", "cam1")
    np.testing.assert_allclose(rig["cam0"].intrinsics, [[458.6, 0, 367.2], [0, 457.3, 248.4], [0, 0, 1]])
    assert (rig["cam0"].width, rig["cam0"].height) == (752, 480)
    assert rig["cam0"].distortion.model == "brown_conrady"
    assert rig["cam0"].distortion.coefficients == (-0.28, 0.07, 0.0002, 1.7e-05)
    assert rig["cam1"].distortion.model == "kannala_brandt"
    assert not rig.ego_from_bev_assumed
    np.testing.assert_allclose(rig.ego_from_bev[:3, 3], [1.5, 0, 1.4])


@pytest.mark.parametrize(("known", "other", "sign"), [("cam0", "cam1", 1), ("cam1", "cam0", -1)])
def test_kalibr_chain_gives_the_pose_of_the_neighbour(tmp_path, known, other, sign):
    """cam1 is 0.11 m right of cam0, 0.02 m above it and 0.03 m behind it: in ego -y, +z and -x."""
    rig = read_rig(*write(tmp_path, KALIBR, {known: POSE}))
    shift = rig[other].ego_from_camera[:3, 3] - rig[known].ego_from_camera[:3, 3]
    np.testing.assert_allclose(shift, sign * np.array([-0.03, -0.11, 0.02]), atol=1e-12)
    assert rig.ego_from_bev_assumed


def test_folder_of_ros_files(tmp_path):
    (tmp_path / "yaml").mkdir()
    (tmp_path / "yaml" / "wide.yaml").write_text(ROS_MESSAGE)
    _, extrinsics = write(tmp_path / "yaml", ROS, {"narrow": POSE, "wide": POSE}, name="a.yml")
    rig = read_rig(tmp_path / "yaml", extrinsics)
    assert set(rig.names) == {"narrow", "wide"}
    assert rig["narrow"].distortion.coefficients == (0.1, -0.2, 0.001, 0.002, 0.03)
    assert rig["wide"].distortion.coefficients == (0.1, 0.2, 0.0, 0.0, 0.1, 0.1, 0.1, 0.1)
    np.testing.assert_allclose(rig["wide"].intrinsics, [[500, 0, 320], [0, 501, 240], [0, 0, 1]])


@pytest.mark.parametrize(
    ("alias", "model"), [("radtan", "brown_conrady"), ("fisheye", "kannala_brandt"), ("equidistant", "kannala_brandt")]
)
def test_a_lens_has_the_names_of_ros_kalibr_and_opencv(tmp_path, alias, model):
    four = ROS.replace("cols: 5, data: [0.1, -0.2, 0.001, 0.002, 0.03]", "cols: 4, data: [0.1, -0.2, 0.001, 0.002]")
    for text, name in ((four.replace("plumb_bob", alias), "narrow"), (KALIBR.replace("radtan", alias), "cam0")):
        assert read_rig(*write(tmp_path, text, {name: POSE}))[name].distortion.model == model
    none = ROS.replace("[0.1, -0.2, 0.001, 0.002, 0.03]", "[0, 0, 0, 0, 0]")
    assert read_rig(*write(tmp_path, none, {"narrow": POSE}))["narrow"].distortion is None


@pytest.mark.parametrize(
    ("text", "poses", "expected"),
    [
        (KALIBR.replace("radtan", "fov"), {"cam0": POSE}, "cam0: distortion_model fov"),
        (KALIBR.replace("pinhole", "omni", 1), {"cam0": POSE}, "cam0: camera_model omni"),
        (KALIBR.replace("[752, 480]", "[752]", 1), {"cam0": POSE}, "cam0.*resolution"),
        (KALIBR.replace("[458.6,", "[.nan,"), {"cam0": POSE}, "cam0.*intrinsics.*finite"),
        (KALIBR.replace("[458.6,", "[0,"), {"cam0": POSE}, "cam0.*singular"),
        (KALIBR, {"cam9": POSE}, "camera cam9: has no intrinsics"),
        (KALIBR.replace("T_cn_cnm1", "T_other"), {"cam0": POSE}, "camera cam1: its pose .* is missing"),
        (KALIBR, {"cam0": {**POSE, "rotation_wxyz": [1, 1, 0, 0]}}, "cam0.*norm"),
        ("a: [", {}, "broken YAML"),
        ("a: 1", {}, "has no camera .expected K, D and T of each camera by name, such as"),
        ("!!python/object/apply:os.getcwd []", {}, "YAML"),
    ],
)
def test_mistakes_name_file_and_camera(tmp_path, text, poses, expected):
    with pytest.raises(InputError, match=expected) as caught:
        read_rig(*write(tmp_path, text, poses))
    assert str(tmp_path) in str(caught.value)
    intrinsics, extrinsics = write(tmp_path, KALIBR, {})
    with pytest.raises(InputError, match=r"cam0: its pose .* is missing"):
        read_rig(intrinsics, None)
    with pytest.raises(InputError, match="must be given together"):
        read_rig(None, extrinsics)
    assert draft_of(RigOptions()) is None


def test_the_example_in_a_refusal_is_read(tmp_path):
    """AirSim's settings are refused with a table to write instead."""
    with pytest.raises(InputError) as refused:
        read(written(tmp_path, '{"SimMode": "Car", "Vehicles": {}}', "settings.json"), None)
    path = written(tmp_path, re.search("such as (.*); others", str(refused.value))[1], "rig.json")
    (tmp_path / "drive/images/front").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "drive/images/front/0.png"), np.zeros((600, 800), np.uint8))
    rig = read(path, tmp_path / "drive").rig
    assert rig["front"].ego_from_camera[:3, 3].tolist() == [1.5, 0, 1.6]
