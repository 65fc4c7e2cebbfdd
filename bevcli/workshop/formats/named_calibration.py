"""A calibration with K, D and T of each camera under their usual names: YAML, JSON, or the XML and YAML of OpenCV.

Kalibr's camchain and ROS's camera_info have such names too. A file is one camera, or a mapping or list of cameras; a
folder holds files.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import cv2
import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array, rigid, rotation_from_quaternion
from bevcli.parsing.documents import first_twice, read_json
from bevcli.parsing.files import read_bytes
from bevcli.sequences.files.calibration_file import LARGEST_BYTES
from bevcli.sequences.files.json_fields import array_of_numbers, parse_numbers, parse_transform, require
from bevcli.workshop.formats.camera_poses import Cameras, Direction, Fields, StatedCamera, StatedPose
from bevcli.workshop.formats.dialects import PROJECTIONS, urdf_document, with_intrinsics_by_name, with_own_names
from bevcli.workshop.formats.markup import YAML_BYTES, parse_xml, read_yaml
from bevcli.workshop.formats.pose_readings import quaternions_of_angles
from bevcli.workshop.formats.pose_table import number_of

SUFFIXES = (".yaml", ".yml", ".json", ".xml", ".urdf")
# Names of values, in lower case and without signs: camera_matrix, cameraMatrix and CameraMatrix are one name.
INTRINSICS = ("intrinsics", "intrinsic", "k", "cameramatrix", "intrinsicmatrix", "mtx", "cameraintrinsic",
              "camintrinsic", "projectionparameters", "p", "projectionmatrix", "cameramat", "cammatrix")  # fmt: skip
LENS = ("distortion", "d", "dist", "distcoeffs", "distortioncoefficients", "distortioncoeffs", "distcoeff",
        "distortionparameters")  # fmt: skip
LENS_MODEL = ("distortionmodel", "lensmodel", "distortiontype")
# Names of ROS, Kalibr and OpenCV.
LENS_NAMES = {
    **dict.fromkeys(("plumb_bob", "rational_polynomial", "radtan", "radial_tangential"), "brown_conrady"),
    **dict.fromkeys(("brown_conrady", "opencv"), "brown_conrady"),
    **dict.fromkeys(("equidistant", "fisheye", "kannala_brandt", "opencv_fisheye"), "kannala_brandt"),
}
WIDTH, HEIGHT = ("width", "imagewidth", "w"), ("height", "imageheight", "h")
SIZE = ("resolution", "imagesize", "size")
FOCAL = ("f", "focallength")
FX, FY = ("fx", "flx", "focallengthxpx", *FOCAL), ("fy", "fly", "focallengthypx", "fx", *FOCAL)
CX, CY = ("cx", "ppx", "u0", "focalcenterxpx"), ("cy", "ppy", "v0", "focalcenterypx")
TRANSFORM = (
    "t",
    "extrinsics",
    "extrinsic",
    "transform",
    "transformmatrix",
    "pose",
    "rt",
    "extrinsicmatrix",
    "cameraextrinsicmat",
    "matrixworld",
    "view",
)
ROTATION = ("rotation", "r", "rotationmatrix", "rotationwxyz", "rotationxyzw", "quaternion", "quaternionwxyz",
            "quaternionxyzw", "q", "qvec", "rvec", "orientation", "rpy", "ypr", "euler", "eulerangles", "rotationeuler",
            "rotationvector")  # fmt: skip
UNIT = re.compile("(deg|rad)(rees|ians)?$")  # ends the name of an angle
ANGLES = ("roll", "pitch", "yaw")
TRANSLATION = ("translation", "t", "position", "tvec", "location", "xyz")
YXZ_FROM_ZYX = np.eye(3)[[1, 2, 0]]  # axes of yaw, pitch and roll: Unity's y, x and z in place of z, y and x
LARGEST_RADIANS = 6.5  # a little more than a turn; larger angles are degrees
CAMERA_FRAMES = r"camera\d*|cam\d*|sensor|c"
FIRST_CAMERAS = ("cam0", "camera0", "c0")
EGO_FRAMES = "ego|vehicle|car|base|body|imu|rig|world|lidar|velo|b"
EXACT: dict[str, Direction] = {"egofromcamera": "ego_from_camera", "camerafromego": "camera_from_ego"}
COEFFICIENTS = {
    "kannala_brandt": ("k1", "k2", "k3", "k4"),
    "brown_conrady": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
PINHOLES = ("pinhole", "none", "perspective")
EXAMPLE = (
    '{"cameras": {"front": {"fx": 700, "fy": 700, "cx": 400, "cy": 300, "x": 1.5, "y": 0, "z": 1.6, "roll": 0, '
    '"pitch": 0, "yaw": 0}}}'
)
NO_TRANSFORM = "is not understood as a transform (expected 4x4 or 3x4 numbers, or a rotation and a translation)"


def read_named(path: Path) -> Cameras | None:
    """The cameras of a file with K, D and T, or of a folder of such files, in which poses may be files of their own.

    None for another calibration. Raises InputError.
    """
    files, cameras = files_in(path) if path.is_dir() else [path], Cameras()
    if not files or (files == [path] and path.suffix.lower() not in SUFFIXES):
        return None
    for file in files:
        for name, of in cameras_of(read_document(file), file).items():
            other = cameras.get(name, of)
            if other is not of and (of.intrinsics is None) == (other.intrinsics is None):
                raise InputError(f"{file}: camera {name} is in another file too: keep one")
            if other is not of:  # intrinsics in one file, and poses in another
                with_intrinsics, with_pose = (of, other) if other.intrinsics is None else (other, of)
                of = replace(with_intrinsics, pose=with_pose.pose or with_intrinsics.pose)
            cameras[name] = of
    return cameras


def files_in(folder: Path) -> list[Path]:
    """The files of a folder that may be calibrations, by their suffix."""
    files = [*sorted(folder.iterdir()), *sorted(folder.glob("cam*/sensor.yaml"))] if folder.is_dir() else []  # EuRoC's
    return [file for file in files if file.suffix.lower() in SUFFIXES]


def _stem(path: Path) -> str:
    """The camera of a file: its name, without _intrinsics, or that of its folder for EuRoC's cam0/sensor.yaml."""
    return path.parent.name if path.name == "sensor.yaml" else re.sub("_(in|ex)trinsics?$", "", path.stem)


def read_document(path: Path) -> Any:
    """The contents of a JSON, XML or YAML file."""
    if path.suffix.lower() == ".json":
        return read_json(path, largest=LARGEST_BYTES)
    if path.suffix.lower() == ".xml":
        return _from_xml(parse_xml(read_bytes(path, YAML_BYTES), path), path)
    if path.suffix.lower() == ".urdf":
        return urdf_document(parse_xml(read_bytes(path, YAML_BYTES), path))
    return read_yaml(path)


def _from_xml(element: Element, path: Path) -> Any:
    """The value of an element that OpenCV's FileStorage writes. Raises InputError for a name twice in an element."""
    children = list(element)
    if not children:
        words = (element.text or "").split()
        numbers = [number_of(word) for word in words]
        return (numbers if len(numbers) > 1 else numbers[0]) if words and None not in numbers else " ".join(words)
    if all(child.tag == "_" for child in children):
        return [_from_xml(child, path) for child in children]
    twice = first_twice([child.tag for child in children])
    if twice is not None:
        tag = children[twice].tag
        raise InputError(f'{path}: "{tag:.60}" appears twice in <{element.tag:.60}>: remove or rename one')
    return {child.tag: _from_xml(child, path) for child in children}


def cameras_of(document: Any, path: Path) -> Cameras:
    """The cameras of a document with their K, D and T by name. Raises InputError, which names `path`."""
    document = with_own_names(document, path)
    expected = f"K, D and T of each camera by name, such as {EXAMPLE}; others: docs/other-inputs.md#calibrations"
    if not document and document is not None:  # frames of other sensors
        return {}
    if isinstance(document, list):
        document = {"cameras": document}
    if not isinstance(document, dict):
        raise InputError(f"{path}: is no mapping (expected {expected})")
    entries = _value(document, "cameras", "sensors", "cameracalibrations", "cameradata")
    intrinsics, extrinsics = (_value(document, f"{key}s", key) for key in ("intrinsic", "extrinsic"))
    if isinstance(intrinsics, dict) and isinstance(extrinsics, dict):  # perhaps a mapping of cameras each
        common = [name for name, of in intrinsics.items() if isinstance(of, (dict, list)) and name in extrinsics]
        entries = {name: {"intrinsics": intrinsics[name], "extrinsics": extrinsics[name]} for name in common} or entries
    if isinstance(entries, list):
        entries = [{"name": entry["key"], **entry["value"]} if isinstance(entry, dict) and "key" in entry
                   and isinstance(entry.get("value"), dict) else entry for entry in entries]  # fmt: skip
        names = [str(_value(entry, "name", "cameraname", "id", "channel", "sensorid") or f"camera{index}")
                 if isinstance(entry, dict) else f"{index}" for index, entry in enumerate(entries)]  # fmt: skip
        for name in (name for index, name in enumerate(names) if name in names[:index]):
            raise InputError(f"{path}: camera {name} is in the list twice: keep one")
        entries = dict(zip(names, entries, strict=True))
    if not isinstance(entries, dict) and _is_camera(document):
        entries = {str(_value(document, "cameraname", "name") or _stem(path)): document}
    if not isinstance(entries, dict):
        inside = [document, *(value for value in document.values() if isinstance(value, dict))]
        entries = next(
            filter(None, ({name: of for name, of in each.items() if _is_camera(of)} for each in inside)), None
        )
    if not entries:
        raise InputError(f"{path}: has no camera (expected {expected})")
    for name, entry in entries.items():
        if not isinstance(entry, dict):
            raise InputError(f"{path}: camera {name}: is no mapping (expected {expected})")
    return {str(name): _named_camera(entry, f"{path}: camera {name}") for name, entry in entries.items()}


def _is_camera(entry: Any) -> bool:
    """True for a mapping with intrinsics or a pose."""
    if not isinstance(entry, dict):
        return False
    names = {*INTRINSICS, *FX[:-2], *map(_plain, PROJECTIONS), *EXACT, *TRANSFORM, *ROTATION, *ANGLES}
    return any(_plain(key) in names or _direction_of(str(key)) is not None for key in entry)


def _plain(key: object) -> str:
    return re.sub("[^a-z0-9]", "", str(key).lower())


def _value(entry: Mapping[Any, Any], *names: str) -> Any:
    """The value of a mapping under the first of several plain names."""
    plain = {_plain(key): value for key, value in entry.items()}
    return next((plain[name] for name in names if plain.get(name) is not None), None)


def _named_camera(entry: Mapping[str, Any], where: str) -> StatedCamera:
    """What a mapping states of a camera."""
    entry = with_intrinsics_by_name(entry)
    model = _lens_name(_value(entry, "cameramodel", "modeltype") or "pinhole")
    if model not in (*PINHOLES, *LENS_NAMES):
        raise InputError(f"{where}: camera_model {model:.60} is not supported (expected pinhole)")
    intrinsics = _value(entry, *INTRINSICS)
    inside = intrinsics if isinstance(intrinsics, dict) else {}  # K, D and the size may be one level deeper
    fields = {**entry, **inside}
    size = _value(fields, *SIZE)
    sides = (_value(fields, *WIDTH), _value(fields, *HEIGHT))
    if isinstance(size, dict):
        sides = (_value(size, *WIDTH), _value(size, *HEIGHT))
    elif size is not None:
        sides = tuple(require(parse_numbers, {"resolution": size}, "resolution", (2,), where=where).tolist())
    chain, lens = entry.get("T_cn_cnm1"), lens_of(fields, model, where)
    is_named = _value(fields, "cameramodel", "modeltype", *LENS_MODEL) is not None
    return StatedCamera(
        _camera_matrix(intrinsics, fields, where),
        sides if None not in sides else None,
        lens,
        _pose(entry, where),
        from_previous=None if chain is None else require(parse_numbers, entry, "T_cn_cnm1", (4, 4), where=where),
        lens_is_open=not is_named
        and isinstance(_value(fields, *LENS), list)
        and len(lens.get("coefficients", ())) == 4,
    )


def _camera_matrix(value: Any, entry: Mapping[str, Any], where: str) -> Any:
    """(3, 3) of a matrix, nine numbers, fx fy cx cy, or a mapping of these."""
    if isinstance(value, dict) and "data" in value:
        value = value["data"]
    elif isinstance(value, dict) and (inner := _value(value, *INTRINSICS)) is not None:
        return _camera_matrix(inner, value, where)
    elif value is None or isinstance(value, dict):
        value = [_value(entry, *names) for names in (FX, FY, CX, CY)]
        if value == [None] * 4:
            return None
    array = array_of_numbers(value)
    if array is not None and array.shape == (4,):
        fx, fy, cx, cy = require(parse_numbers, {"intrinsics": value}, "intrinsics", (4,), where=where).tolist()
        return [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    if array is not None and array.size in (9, 12):  # the latter projects, as ROS's P
        value = array.reshape(3, -1)[:, :3].tolist()
    return require(parse_numbers, {"intrinsics": value}, "intrinsics", (3, 3), where=where).tolist()


def lens_of(entry: Mapping[str, Any], camera_model: str, where: str) -> Fields:
    """The lens as in calibration.json: coefficients as a list, a matrix, or by name."""
    model, value = _value(entry, *LENS_MODEL), _value(entry, *LENS)
    if isinstance(value, dict):
        model = _value(value, "model", "type", *LENS_MODEL) or model
        value = _value(value, "data", "coefficients", "coeffs", "params") or value
    fisheye = LENS_NAMES.get(_lens_name(model or camera_model)) == "kannala_brandt"
    if value is None or isinstance(value, dict):
        stated = {_plain(name) for name in value or entry}
        fisheye = fisheye or (not model and {"k3", "k4"} <= stated and not stated & {"p1", "p2", "k5"})
        model = "fisheye" if fisheye else model
        names = COEFFICIENTS["kannala_brandt" if fisheye else "brown_conrady"]
        numbers = [_value(value or entry, name) for name in names]
        count = max((position for position, number in enumerate(numbers, 1) if number is not None), default=0)
        value = [number or 0 for number in numbers][: next((length for length in (0, 4, 5) if count <= length), 8)]
    if isinstance(value, list) and value and all(isinstance(row, list) for row in value):
        value = [number for row in value for number in row]  # a column or a row of a matrix
    fallback = camera_model if camera_model in LENS_NAMES else "plumb_bob"
    stated_model = _lens_name(model) if model else fallback
    return lens_fields(fallback if stated_model in PINHOLES else stated_model, value, where)


def _lens_name(model: object) -> str:
    return str(model).lower().replace("-", "_")


def lens_fields(model: object, coefficients: object, where: str) -> Fields:
    """The lens as in calibration.json, of a model's name in ROS, Kalibr or OpenCV. Raises InputError for another."""
    if not isinstance(coefficients, list):
        raise InputError(f"{where}: the distortion coefficients must be a list, found {coefficients!r:.60}")
    if not any(coefficients):
        return {"model": "none"}
    lens = LENS_NAMES.get(_lens_name(model) or "plumb_bob")
    if lens is None:
        expected = ", ".join(LENS_NAMES)
        raise InputError(f"{where}: distortion_model {model!s:.60} is not supported (expected {expected})")
    used = 8 if lens == "brown_conrady" and not any(coefficients[8:]) else None  # OpenCV states up to 14, of 0
    return {"model": lens, "coefficients": coefficients[:used]}


def _pose(entry: Mapping[str, Any], where: str) -> StatedPose | None:
    """The pose of a camera under a name that states its direction, or under another one."""
    roots = [str(key).removesuffix("_rotation") for key in entry if str(key).endswith("_rotation")]
    entry = {
        **{root: {part: entry.get(f"{root}_{part}") for part in ("rotation", "translation")} for root in roots}, **entry
    }  # fmt: skip
    # Poses from another camera tell less than those on the vehicle.
    for key, value in sorted(entry.items(), key=lambda item: str(item[0]).lower().count("cam") > 1):
        exact = EXACT.get(_plain(key))
        direction = exact or _direction_of(str(key))
        if exact and isinstance(value, dict):
            return StatedPose({"": require(parse_transform, {exact: value}, exact, where=where)}, exact, exact=True)
        if direction is not None and (matrices := _matrices(value)):
            return StatedPose(matrices, direction, exact=exact is not None, name=str(key))
        if direction is not None:
            raise InputError(f"{where}: {key}: {NO_TRANSFORM}")
    if matrices := _matrices(dict(entry)):
        return StatedPose(matrices, name="rotation and translation")
    named_value = next(((str(key), value) for key, value in entry.items() if _plain(key) in TRANSFORM), None)
    if named_value is None or named_value[1] is None:
        return None
    if matrices := _matrices(named_value[1]):
        return StatedPose(matrices, name=named_value[0])
    inner = _pose(named_value[1], where) if isinstance(named_value[1], dict) else None
    if inner is None:
        raise InputError(f"{where}: {named_value[0]}: {NO_TRANSFORM}")
    return inner


def _direction_of(key: str) -> Direction | None:
    """The direction that a name states, such as T_cam_ego, cam2ego, camera_to_vehicle; None for another name."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", key).lower().replace("_se3_", "_from_").strip("_")
    words = re.sub(r"(?<=[a-z])2(?=[a-z])", "_to_", re.sub("base_link|vehicle_frame", "base", words))
    match = re.fullmatch(
        rf"(?:t_|tf_)?({CAMERA_FRAMES}|{EGO_FRAMES})_(?:(from|to|t)_)?({CAMERA_FRAMES}|{EGO_FRAMES})", words
    )
    if key in ("T_BS", "T_bs"):
        return "ego_from_camera"  # EuRoC: body and sensor
    if match is None:
        return None
    are_cameras = [bool(re.fullmatch(CAMERA_FRAMES, match[end])) for end in (1, 3)]
    if all(are_cameras):  # the frame of the first camera is that of the rig
        are_cameras = [match[end] not in FIRST_CAMERAS for end in (1, 3)]
    if are_cameras[0] == are_cameras[1]:
        return None
    return "ego_from_camera" if are_cameras[0] == (match[2] == "to") else "camera_from_ego"


def _matrices(value: Any) -> dict[str, Array]:
    """The (4, 4) transforms that a value may state: two for four numbers of a quaternion in an unknown order."""
    if isinstance(value, dict) and "data" in value:
        value = value["data"]
    if isinstance(value, dict):
        units = {match[1] for key in value if (match := UNIT.search(_plain(key)))}
        plain = _with_vectors({UNIT.sub("", _plain(key)): item for key, item in value.items()})
        rotation = next(((name, plain[name]) for name in ROTATION if plain.get(name) is not None), None)
        # Under "T" and "t", a translation has three numbers.
        translation = next(
            (item for name in TRANSLATION if (item := _numbers(plain.get(name))) is not None and item.size == 3), None
        )
        if rotation is None or translation is None:
            return {}
        rotations = _rotations(*rotation)
        kinds = [kind for kind in rotations if units and kind != "vector" and ("rad" in kind) == ("rad" in units)]
        return {kind: rigid(translation.ravel(), rotations[kind]) for kind in kinds or rotations}
    array = _numbers(value)
    if array is None or array.size not in (12, 16):
        return {}
    matrix = np.eye(4)
    matrix[: array.size // 4] = array.reshape(-1, 4)
    if array.size == 16 and not matrix[:3, 3].any() and matrix[3, :3].any():  # column by column
        matrix = matrix.T
    return {"": matrix} if np.allclose(matrix[3], [0, 0, 0, 1]) else {}


def _with_vectors(plain: Fields) -> Fields:
    """A mapping whose x, y, z, roll, pitch and yaw are one translation and one rotation."""
    parts = {"rpy": ANGLES, "xyz": "xyz", "rotationwxyz": ("qw", "qx", "qy", "qz"), "translation": ("tx", "ty", "tz")}
    axes = [array_of_numbers(plain.get(name)) for name in ("xaxis", "yaxis")]
    x, y = (axis / np.linalg.norm(axis) if axis is not None and axis.any() else np.zeros(0) for axis in axes)
    if len(x) == len(y) == 3:  # Audi's
        turn = np.column_stack([x, y, np.cross(x, y)])
        plain = plain | {"rotation": turn.tolist(), "translation": plain.get("origin")}
    vectors = {name: [plain.get(part) for part in of] for name, of in parts.items()}
    return plain | {name: numbers for name, numbers in vectors.items() if None not in numbers}


def _numbers(value: Any) -> Array | None:
    if isinstance(value, dict):
        value = value.get("data", value.get("coefficients", [value.get(axis) for axis in "xyz"]))
    return array_of_numbers(value)


def _rotations(name: str, value: Any) -> dict[str, Array]:
    """(3, 3) rotations by the order of the quaternion; "" where there is one."""
    for axes in ("w x y z", "qw qx qy qz"):
        if isinstance(value, dict) and {*axes.split()} <= value.keys():
            name, value = "rotationwxyz", [value[axis] for axis in axes.split()]
    if isinstance(value, dict) and {*ANGLES} <= value.keys():
        name, value = "rpy", [value[angle] for angle in ANGLES]
    array = _numbers(value)
    if array is None:
        return {}
    if array.size == 9:
        return {"": array.reshape(3, 3)}
    if array.size == 3:
        return _rotations_of_three(name, array.ravel())
    if array.size != 4 or abs(np.linalg.norm(array) - 1) > 0.01:
        return {}
    orders = {"wxyz": array.ravel(), "xyzw": np.roll(array.ravel(), 1)}
    possible = {order for order in orders if name.endswith(order)} or ({"wxyz"} if name == "qvec" else set(orders))
    return {order if len(possible) > 1 else "": rotation_from_quaternion(orders[order]) for order in sorted(possible)}


def _rotations_of_three(name: str, numbers: Array) -> dict[str, Array]:
    """(3, 3) rotations by what three numbers may be: a rotation vector, or roll, pitch and yaw in either unit."""
    rotations, largest = {}, float(np.abs(numbers).max())
    numbers = numbers[::-1] if name == "ypr" else numbers
    if largest <= LARGEST_RADIANS and name not in ("rpy", "ypr", "euler", "eulerangles", "rotationeuler"):
        rotations["vector"] = np.asarray(cv2.Rodrigues(numbers)[0], dtype=np.float64)
    if name not in ("rvec", "r"):
        mirrored = numbers * [1, -1, -1]  # pitch and yaw
        kinds = [("radians", numbers), ("degrees", np.radians(numbers))]
        kinds += [("clockwise-radians", mirrored), ("clockwise", np.radians(mirrored))]
        for unit, angles in kinds:
            if largest <= LARGEST_RADIANS or "radians" not in unit:
                rotations[unit] = rotation_from_quaternion(quaternions_of_angles(*angles[:, None])[0])
        rotations["unity"] = YXZ_FROM_ZYX @ rotations["degrees"] @ YXZ_FROM_ZYX.T
    return rotations
