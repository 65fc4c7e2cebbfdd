"""Calibrations of programs with names or axes of their own, as documents with K, D and T of each camera by name.

Autoware and URDF state x, y, z, roll, pitch and yaw of each frame from its parent, in metres and radians. Autoware has
two files: `sensors_calibration.yaml` places the kit of sensors on the vehicle (`base_link`), and
`sensor_kit_calibration.yaml` the cameras on the kit. The frame of a camera is that of its body, `camera0/camera_link`
with x forward, y left, z up, or that of its image, `camera0/camera_optical_link`.

CARLA has lists of sensors: those of an agent of its leaderboard, and `objects.json` of its ROS bridge. A sensor has x,
y, z in metres and roll, pitch, yaw in degrees. The axes are x forward, y right, z up, with yaw to the right and pitch
upwards; in a `spawn_point` of the ROS bridge they are those of ROS. A camera has a field of view.

ORB-SLAM names the camera in its settings: Camera.fx, or Camera1.fx and Camera2.fx of two. Waymo has nine intrinsics.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

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
Frames = dict[str, tuple[str, Array]]  # frame -> its parent, and (4, 4) parent_from_frame
CARLA_CAMERA, FOV_DEG = "sensor.camera.", 90.0  # begins the type of a sensor; of a camera that states none
ORB_CAMERA = re.compile(r"Camera(\d*)\.(.+)")
ORB_LENSES = {"kannalabrandt8": "fisheye", "kannalabrandt": "fisheye"}  # by Camera.type; others are pinhole cameras
WAYMO = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


def with_own_names(document: Any, path: Path) -> Any:
    """A document of Autoware, URDF, CARLA or ORB-SLAM with K, D and T; any other document as it is. Raises InputError.

    path: the file, beside which Autoware has another one.
    """
    document = _of_carla(_of_frames(document, path), path)
    return _of_orb_slam(document) if isinstance(document, dict) else document


def with_intrinsics_by_name(entry: Mapping[str, Any]) -> Mapping[str, Any]:
    """The statements of a camera, with Waymo's nine numbers by name. The last of nine numbers of a matrix is 1."""
    for key in ("intrinsic", "intrinsics"):
        numbers = array_of_numbers(entry.get(key))
        if numbers is not None and numbers.shape == (9,) and numbers[8] != 1:
            return {**entry, key: None, **dict(zip(WAYMO, numbers.tolist(), strict=True))}
    return entry


def _of_frames(document: Any, path: Path) -> Any:
    frames = _frames(document, path)
    beside = path.parent / ON_VEHICLE
    if frames and VEHICLE not in (parent for parent, _ in frames.values()) and is_there(beside):
        frames |= _frames(read_yaml(beside), beside)
    cameras: dict[str, dict[str, Any]] = {}
    for frame in sorted(frames, key=lambda name: "optical" in name):  # the frame of the image replaces that of the body
        match = FRAME.search(frame)
        if match is not None and "cam" in frame.lower():
            root, root_from_frame = _from_root(frames, frame)
            matrix = root_from_frame if match["optical"] else root_from_frame @ BODY_FROM_OPTICAL
            name = "ego_from_camera" if root == VEHICLE else "T_rig_camera"
            cameras[frame[: match.start()] or frame] = {name: matrix.tolist()}
    return cameras or document  # cameras by their names may have such numbers too


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
