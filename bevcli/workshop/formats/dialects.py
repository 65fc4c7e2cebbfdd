"""Calibrations of programs with names or axes of their own, as documents with K, D and T of each camera by name.

Autoware and URDF state x, y, z, roll, pitch and yaw of each frame from its parent, in metres and radians. Autoware has
two files: `sensors_calibration.yaml` places the kit of sensors on the vehicle (`base_link`), and
`sensor_kit_calibration.yaml` the cameras on the kit. The frame of a camera is that of its body, `camera0/camera_link`
with x forward, y left, z up, or that of its image, `camera0/camera_optical_link`. ROS prints such frames as messages
with a quaternion (`/tf_static`). Apollo has one such message a file, whose frame does not tell the axes of the camera.

CARLA has lists of sensors: those of an agent of its leaderboard, and `objects.json` of its ROS bridge. A sensor has x,
y, z in metres and roll, pitch, yaw in degrees. The axes are x forward, y right, z up, with yaw to the right and pitch
upwards; in a `spawn_point` of the ROS bridge they are those of ROS. A camera has a field of view.

ORB-SLAM names the camera in its settings: Camera.fx, or Camera1.fx and Camera2.fx of two. Waymo has nine intrinsics.
Basalt has the poses and the intrinsics of cam0, cam1 in lists.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import cv2
import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array, inverse, rigid, rotation_from_quaternion
from bevcli.parsing.files import is_there
from bevcli.sequences.files.json_fields import array_of_numbers
from bevcli.workshop.formats.camera_poses import AXES
from bevcli.workshop.formats.markup import read_yaml
from bevcli.workshop.formats.pose_readings import quaternions_of_angles

NUMBERS = ("x", "y", "z", "roll", "pitch", "yaw")
ON_VEHICLE, VEHICLE = "sensors_calibration.yaml", "base_link"  # the file beside that of a kit, and its frame
FRAME = re.compile(r"[/_]?(?:camera_)?(?:base_)?(?P<optical>optical_)?(?:link|frame)$")
BODY_FROM_OPTICAL = inverse(rigid(rotation=AXES["vehicle"]))
OTHER_SENSORS = re.compile("lidar|velo|radar|imu|gnss|gps|novatel|base", re.IGNORECASE)  # frames of no camera
BASALT_LENSES = {"kb4": "fisheye", "pinhole-radtan8": "pinhole"}  # by camera_type; others have their own name
Frames = dict[str, tuple[str, Array]]  # frame -> its parent, and (4, 4) parent_from_frame
CARLA_CAMERA, FOV_DEG = "sensor.camera.", 90.0  # begins the type of a sensor; of a camera that states none
ORB_CAMERA = re.compile(r"Camera(\d*)\.(.+)")
ORB_LENSES = {"kannalabrandt8": "fisheye", "kannalabrandt": "fisheye"}  # by Camera.type; others are pinhole cameras
PROJECTIONS, ROUNDED = {"P", "projection_matrix", "lidar2img", "ego2img", "world2img"}, 1e-3  # of K times T
WAYMO = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


def with_own_names(document: Any, path: Path) -> Any:
    """A document of Autoware, URDF, CARLA or ORB-SLAM with K, D and T; any other document as it is. Raises InputError.

    path: the file, beside which Autoware has another one.
    """
    document = _of_basalt(_of_carla(_of_frames(document, path), path))
    return _of_orb_slam(document) if isinstance(document, dict) else document


def with_intrinsics_by_name(entry: Mapping[str, Any]) -> Mapping[str, Any]:
    """The statements of a camera, with K and T in usual ways.

    Waymo's nine numbers get names: the last of nine of a matrix is 1. MATLAB's K and size are turned round. A
    projection (`lidar2img`, `P`) is taken apart into K and T where it is not K alone.
    """
    matrix = array_of_numbers(entry.get("IntrinsicMatrix"))
    if matrix is not None and matrix.shape == (3, 3) and matrix[2, :2].any():
        size = entry.get("ImageSize")
        return {
            **entry,
            "IntrinsicMatrix": matrix.T.tolist(),
            "ImageSize": size[::-1] if isinstance(size, list) else size,
        }
    for key in PROJECTIONS & entry.keys():
        numbers = array_of_numbers(entry[key])
        is_matrix = numbers is not None and numbers.shape in ((3, 4), (4, 4))
        if numbers is not None and is_matrix and np.abs(np.tril(numbers[:3, :3], -1)).max() > ROUNDED:
            k, rotation, place, *_ = map(np.array, cv2.decomposeProjectionMatrix(numbers[:3]))
            camera_from_ego = rigid(-rotation @ place[:3, 0] / place[3, 0], rotation)
            return {**entry, key: None, "K": (k / k[2, 2]).tolist(), "T_camera_ego": camera_from_ego.tolist()}
    for key in ("intrinsic", "intrinsics"):
        numbers = array_of_numbers(entry.get(key))
        if numbers is not None and numbers.shape == (9,) and numbers[8] != 1:
            return {**entry, key: None, **dict(zip(WAYMO, numbers.tolist(), strict=True))}
    return entry


def _of_frames(document: Any, path: Path) -> Any:
    stamped = _stamped(document, path)
    frames = stamped or _frames(document, path)
    own = list(frames)
    beside = path.parent / ON_VEHICLE
    is_whole = all(_from_root(frames, frame)[0] == VEHICLE for frame in own)
    if stamped and not is_whole:
        files = [file for file in path.parent.glob("*.yaml") if file != path]
        frames = {name: at for file in files for name, at in _stamped(read_yaml(file), file).items()} | frames
    elif not is_whole and is_there(beside):
        frames |= _frames(read_yaml(beside), beside)
    cameras: dict[str, dict[str, Any]] = {}
    for frame in sorted(own, key=lambda name: "optical" in name):  # the frame of the image replaces that of the body
        match = FRAME.search(frame)
        is_camera = match is not None and "cam" in frame.lower()
        if is_camera or (stamped and match is None and not OTHER_SENSORS.search(frame)):
            root, root_from_frame = _from_root(frames, frame)
            matrix = root_from_frame if match is None or match["optical"] else root_from_frame @ BODY_FROM_OPTICAL
            name = "ego_from_camera" if match and root == VEHICLE else "T_rig_camera"
            cameras[(frame[: match.start()] if match else "") or frame] = {name: matrix.tolist()}
    return cameras or ({} if stamped else document)  # cameras by their names may have such numbers too


def _stamped(document: Any, path: Path) -> Frames:
    """The frames of messages geometry_msgs/TransformStamped; none for another document."""
    frames: Frames = {}
    messages = document.get("transforms", [document]) if isinstance(document, dict) else []
    for each in messages if isinstance(messages, list) else []:
        header, transform = (each.get(name) for name in ("header", "transform")) if isinstance(each, dict) else (0, 0)
        if not isinstance(header, dict) or not isinstance(transform, dict) or "child_frame_id" not in each:
            return {}
        parts = [(transform.get(name), axes) for name, axes in (("rotation", "wxyz"), ("translation", "xyz"))]
        rotation, translation = (
            array_of_numbers([of.get(axis) for axis in axes]) if isinstance(of, dict) else None for of, axes in parts
        )
        name = str(each["child_frame_id"])
        if rotation is None or translation is None or not np.isfinite([*rotation, *translation]).all():
            raise InputError(
                f"{path}: {name}: transform: expected finite numbers x, y, z of translation, and of rotation w"
            )
        frames[name] = str(header.get("frame_id")), rigid(translation, rotation_from_quaternion(rotation))
    return frames


def _frames(document: Any, path: Path) -> Frames:
    """The frames of {parent: {frame: {x, …, yaw}}}; none for another document."""
    frames: Frames = {}
    for parent, children in document.items() if isinstance(document, dict) else ():
        if not isinstance(children, dict) or not children:
            return {}
        for name, pose in children.items():
            if not isinstance(pose, dict) or not set(NUMBERS) <= pose.keys():
                return {}
            numbers = array_of_numbers([pose[key] for key in NUMBERS])
            if numbers is None or not np.isfinite(numbers).all():
                raise InputError(f"{path}: {name}: {', '.join(NUMBERS)}: expected finite numbers")
            frames[str(name)] = str(parent), _parent_from_frame(numbers[:3], numbers[3:])
    return frames


def _parent_from_frame(translation: Array, angles: Array) -> Array:
    """(4, 4) of URDF: metres, and roll, pitch and yaw about fixed axes, radians."""
    return rigid(translation, rotation_from_quaternion(quaternions_of_angles(*angles[:, None])[0]))


def _from_root(frames: Frames, frame: str) -> tuple[str, Array]:
    """The frame that has no parent, and (4, 4) root_from_frame."""
    root_from_frame, seen = np.eye(4), set[str]()
    while frame in frames and frame not in seen:
        seen.add(frame)
        frame, parent_from_frame = frames[frame]
        root_from_frame = parent_from_frame @ root_from_frame
    return frame, root_from_frame


def urdf_document(robot: Element) -> dict[str, Any]:
    """The joints of a URDF, as Autoware's files have them."""
    document: dict[str, Any] = {}
    for joint in robot.iter("joint"):
        parent, child = (
            element.get("link", "") if (element := joint.find(end)) is not None else "" for end in ("parent", "child")
        )
        document.setdefault(parent, {})[child] = dict(zip(NUMBERS, _origin(joint), strict=True))
    return document


def _origin(joint: Element) -> Iterator[float | None]:
    origin = joint.find("origin")
    for name in ("xyz", "rpy"):
        words = ("0 0 0" if origin is None else origin.get(name, "0 0 0")).split()
        for index in range(3):
            try:
                yield float(words[index])
            except (IndexError, ValueError):
                yield None


def _of_carla(document: Any, path: Path) -> Any:
    lists = document.get("objects", [document]) if isinstance(document, dict) else [{"sensors": document}]
    sensors = [
        sensor for each in lists if isinstance(each, dict) and isinstance(each.get("sensors"), list)
        for sensor in each["sensors"] if isinstance(sensor, dict) and str(sensor.get("type")).startswith(CARLA_CAMERA)
    ] if isinstance(lists, list) else []  # fmt: skip
    names = [str(sensor.get("id", f"camera{index}")) for index, sensor in enumerate(sensors)]
    cameras = {name: _carla_camera(sensor, path) for name, sensor in zip(names, sensors, strict=True)}
    return {"cameras": cameras} if cameras else document


def _carla_camera(sensor: dict[str, Any], path: Path) -> dict[str, Any]:
    place = sensor.get("spawn_point", sensor)
    size = [sensor.get(f"image_size_{axis}", sensor.get(side)) for axis, side in (("x", "width"), ("y", "height"))]
    numbers = [place.get(name, 0.0) for name in NUMBERS] if isinstance(place, dict) else []
    values = array_of_numbers([*numbers, *size, sensor.get("fov", FOV_DEG)])
    if values is None or len(values) != len(NUMBERS) + 3 or not np.isfinite(values).all() or not 0 < values[-1] < 180:
        expected = f"numbers for {', '.join(NUMBERS)}, image_size_x, image_size_y and fov"
        raise InputError(f"{path}: camera {sensor.get('id')}: expected {expected}")
    *numbers, width, height, fov_deg = values.tolist()
    translation, angles = np.array(numbers[:3]), np.radians(numbers[3:])
    if place is sensor:  # with y to the right
        translation, angles = translation * [1, -1, 1], angles * [1, -1, -1]
    focal = width / 2 / np.tan(np.radians(fov_deg) / 2)
    return {
        "width": width, "height": height, "K": [[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]],
        "ego_from_camera": (_parent_from_frame(translation, angles) @ BODY_FROM_OPTICAL).tolist(),
    }  # fmt: skip


def _of_basalt(document: Any) -> Any:
    """The cameras of Basalt's lists; other documents as they are."""
    value = document.get("value0") if isinstance(document, dict) else None
    lists = [value.get(name) for name in ("T_imu_cam", "intrinsics", "resolution")] if isinstance(value, dict) else []
    if not lists or not all(isinstance(each, list) for each in lists):
        return document
    cameras: dict[str, dict[str, Any]] = {}
    for index, (pose, camera, size) in enumerate(zip(*lists, strict=False)):
        if not isinstance(pose, dict) or not isinstance(camera, dict) or not isinstance(camera.get("intrinsics"), dict):
            return document
        kind = str(camera.get("camera_type"))
        cameras[f"cam{index}"] = {
            **camera["intrinsics"], "camera_model": BASALT_LENSES.get(kind, kind), "resolution": size,
            "T_imu_cam": {"translation": [pose.get(f"p{axis}") for axis in "xyz"],
                          "rotation_xyzw": [pose.get(f"q{axis}") for axis in "xyzw"]},
        }  # fmt: skip
    return {"cameras": cameras}


def _of_orb_slam(document: dict[Any, Any]) -> dict[str, Any]:
    """The values of each camera together: those of one at the top, those of two as `cameras`."""
    numbers = {match[1] for key in document if (match := ORB_CAMERA.fullmatch(str(key)))} - {""}
    if len(numbers) < 2:
        return {re.sub(r"\ACamera\d*\.", "", str(key)): value for key, value in document.items()}
    cameras: dict[str, dict[str, Any]] = {number: {} for number in sorted(numbers)}
    for key, value in document.items():
        if (match := ORB_CAMERA.fullmatch(str(key))) is not None:
            for number in [match[1]] if match[1] else cameras:
                cameras[number][match[2]] = value
    for camera in cameras.values():
        camera["camera_model"] = ORB_LENSES.get(str(camera.pop("type", "")).lower(), "pinhole")
    pose = document.get("IMU.T_b_c1", document.get("Tbc"))
    if pose is not None and "1" in cameras:
        cameras["1"]["T_body_camera"] = pose
    stereo = document.get("Stereo.T_c1_c2")
    matrix = array_of_numbers(stereo.get("data") if isinstance(stereo, dict) else stereo)
    if matrix is not None and matrix.size == 16 and "2" in cameras:
        cameras["2"]["T_cn_cnm1"] = inverse(np.reshape(matrix, (4, 4))).tolist()
    return {"cameras": {f"Camera{number}": camera for number, camera in cameras.items()}}
