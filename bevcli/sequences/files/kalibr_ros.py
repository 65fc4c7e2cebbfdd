"""A rig from intrinsics in YAML (Kalibr camchain or ROS camera_info) and extrinsics in JSON."""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

from bevcli.errors import InputError
from bevcli.geometry.cameras import Camera, CameraRig, default_ego_from_bev
from bevcli.geometry.transforms import Array, inverse
from bevcli.parsing.documents import read_json, read_yaml
from bevcli.sequences.files.calibration_file import LENS_NAMES, parse_camera
from bevcli.sequences.files.json_fields import parse_numbers, parse_transform, require, transform_to_json

Fields = dict[str, Any]  # the fields of one camera, as in calibration.json
YAML_SUFFIXES = (".yaml", ".yml")
CHAIN = "camera_from_previous"  # key of Kalibr's T_cn_cnm1 in Fields, until all poses are known


def read_rig(intrinsics: Path | None, extrinsics: Path | None) -> CameraRig:
    """The rig of an intrinsics and an extrinsics file.

    intrinsics: a Kalibr camchain, a ROS camera_info, or a folder of these.
    extrinsics: JSON with each camera's pose and, optionally, the bev frame:
        {"ego_from_bev": {...}, "cameras": {"cam0": {"ego_from_camera": {"translation": ..., "rotation_wxyz": ...}}}}
        A camera that is missing there gets its pose from its neighbour and T_cn_cnm1 of the camchain.
    Raises InputError if one file is given without the other, or one is missing or invalid.
    """
    if intrinsics is None or extrinsics is None:
        raise InputError("`intrinsics` and `extrinsics` must be given together: pass both, or write a calibration.json")
    cameras = _intrinsics_in(intrinsics)
    document = read_json(extrinsics)
    if not isinstance(document, dict) or not isinstance(document.get("cameras"), dict):
        expected = '{"cameras": {"cam0": {"ego_from_camera": ...}}}'
        raise InputError(f'{extrinsics}: "cameras" is missing (expected {expected})')
    poses = _poses(document["cameras"], cameras, extrinsics)
    rig_cameras = tuple(_camera(name, fields, poses.get(name), extrinsics) for name, fields in cameras.items())
    if "ego_from_bev" not in document:
        return CameraRig(rig_cameras, default_ego_from_bev(), ego_from_bev_assumed=True)
    return CameraRig(rig_cameras, require(parse_transform, document, "ego_from_bev", where=extrinsics))


def _intrinsics_in(path: Path) -> dict[str, Fields]:
    files = [path]
    if path.is_dir():
        files = [file for file in sorted(path.iterdir()) if file.suffix.lower() in YAML_SUFFIXES]
        if not files:
            raise InputError(f"{path}: the folder has no .yaml file (expected Kalibr or ROS intrinsics)")
    cameras: dict[str, Fields] = {}
    for file in files:
        for name, fields in _cameras_in(file):
            if name in cameras:
                raise InputError(f"{file}: camera {name} is in another file too: keep one")
            cameras[name] = fields
    return cameras


def _cameras_in(path: Path) -> Iterator[tuple[str, Fields]]:
    document = read_yaml(path)
    if not isinstance(document, dict):
        raise InputError(f"{path}: expected a mapping (Kalibr camchain or ROS camera_info)")
    if "image_width" in document or "width" in document:
        yield str(document.get("camera_name") or path.stem), _ros_fields(document, path)
    elif any(isinstance(entry, dict) and "intrinsics" in entry for entry in document.values()):
        for name, entry in document.items():
            yield str(name), _kalibr_fields(entry, f"{path}: camera {name}")
    else:
        raise InputError(f"{path}: expected a Kalibr camchain (cam0: intrinsics: ...) or a ROS camera_info")


def _kalibr_fields(entry: Any, where: str) -> Fields:
    if not isinstance(entry, dict):
        raise InputError(f"{where}: expected a mapping with intrinsics and resolution")
    if entry.get("camera_model", "pinhole") != "pinhole":
        raise InputError(f"{where}: camera_model {entry['camera_model']!s:.60} is not supported (expected pinhole)")
    fx, fy, cx, cy = _numbers(entry, "intrinsics", 4, where)
    width, height = _numbers(entry, "resolution", 2, where)
    fields: Fields = {
        "width": int(width),
        "height": int(height),
        "intrinsics": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
        "distortion": lens_fields(entry.get("distortion_model", "none"), entry.get("distortion_coeffs") or [], where),
    }
    if "T_cn_cnm1" in entry:
        fields[CHAIN] = require(parse_numbers, entry, "T_cn_cnm1", (4, 4), where=where)
    return fields


def _ros_fields(document: Mapping[str, Any], path: Path) -> Fields:
    """Fields of a ROS calibration file (camera_matrix: {data: ...}) or printed message (k: [...] or K: [...])."""
    where = str(path)
    matrix = _data(document, "camera_matrix") or document.get("k") or document.get("K")
    coefficients = _data(document, "distortion_coefficients") or document.get("d") or document.get("D")
    numbers = _numbers({"camera_matrix": matrix}, "camera_matrix", 9, where)
    return {
        "width": document.get("image_width", document.get("width")),
        "height": document.get("image_height", document.get("height")),
        "intrinsics": [numbers[0:3], numbers[3:6], numbers[6:9]],
        "distortion": lens_fields(document.get("distortion_model") or "plumb_bob", coefficients or [], where),
    }


def _data(document: Mapping[str, Any], name: str) -> Any:
    value = document.get(name)
    return value.get("data") if isinstance(value, dict) else None


def _numbers(owner: Mapping[str, Any], name: str, count: int, where: str) -> list[float]:
    return require(parse_numbers, owner, name, (count,), where=where).tolist()


def lens_fields(model: object, coefficients: object, where: str) -> Fields:
    """The lens as in calibration.json, of a model's name in ROS, Kalibr or OpenCV. Raises InputError for another."""
    if not isinstance(coefficients, list):
        raise InputError(f"{where}: the distortion coefficients must be a list, found {coefficients!r:.60}")
    if not any(coefficients):
        return {"model": "none"}
    lens = LENS_NAMES.get(str(model).lower() or "plumb_bob")
    if lens is None:
        expected = ", ".join(LENS_NAMES)
        raise InputError(f"{where}: distortion_model {model!s:.60} is not supported (expected {expected})")
    used = 8 if lens == "brown_conrady" and not any(coefficients[8:]) else None  # OpenCV states up to 14, of 0
    return {"model": lens, "coefficients": coefficients[:used]}


def _poses(stated: Mapping[str, Any], cameras: Mapping[str, Fields], path: Path) -> dict[str, Array]:
    """ego_from_camera (4, 4) by camera: as stated, otherwise along Kalibr's chain in the file's order."""
    poses: dict[str, Array] = {}
    for name, entry in stated.items():
        if name not in cameras:
            raise InputError(f"{path}: camera {name}: has no intrinsics (found those of {', '.join(cameras)})")
        owner = entry if isinstance(entry, dict) else {}
        poses[name] = require(parse_transform, owner, "ego_from_camera", where=path, camera=name)
    order = list(cameras)
    for earlier, name in pairwise(order):  # along the chain
        if name not in poses and earlier in poses and CHAIN in cameras[name]:
            poses[name] = poses[earlier] @ inverse(cameras[name][CHAIN])
    for earlier, name in zip(order[-2::-1], order[:0:-1], strict=False):  # and back
        if earlier not in poses and name in poses and CHAIN in cameras[name]:
            poses[earlier] = poses[name] @ cameras[name][CHAIN]
    return poses


def _camera(name: str, fields: Fields, ego_from_camera: Array | None, path: Path) -> Camera:
    if ego_from_camera is None:
        raise InputError(f'{path}: camera {name}: "ego_from_camera" is missing: add the camera\'s pose')
    own = {key: value for key, value in fields.items() if key != CHAIN}
    own["ego_from_camera"] = transform_to_json(ego_from_camera)
    return require(parse_camera, name, own, where=path, camera=name)
