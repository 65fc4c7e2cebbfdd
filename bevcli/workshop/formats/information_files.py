"""Information files of BEVDet, BEVFormer and mmdetection3d: `nuscenes_infos_val.pkl`, or the same as JSON.

An entry has the cameras of a sample: `cams` with `sensor2ego_rotation` and `cam_intrinsic`, or, from mmdetection3d 1.1
on, `images` with `cam2ego` and `cam2img`. Where only the lidar is named (`sensor2lidar_rotation`, `lidar2cam`,
`lidar2img`), its pose on the vehicle (`lidar2ego`) is needed, or the rig is that of the lidar.

Of a pickle, plain values and NumPy's arrays of numbers are read. Nothing is called or imported.
"""

import io
import pickle
import pickletools
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import rq

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array, inverse, rigid, rotation_from_quaternion
from bevcli.parsing.documents import read_json
from bevcli.parsing.files import MIB, open_regular, read_bytes
from bevcli.printing import reason_of
from bevcli.sequences.files.json_fields import array_of_numbers
from bevcli.workshop.formats.camera_poses import Cameras
from bevcli.workshop.formats.named_calibration import cameras_of

LARGEST_BYTES = 1024 * MIB
PICKLES = (".pkl", ".pickle")
LISTS = ("infos", "data_list")
HEAD_BYTES = 4096  # of a JSON file, in which the name of a list stands
SAME_M = 1e-3


def read_information(path: Path) -> Cameras | None:
    """The cameras of an information file, whose entries must have one rig; None for another calibration.

    It is a pickle, or a JSON file with a list of entries. Raises InputError.
    """
    is_pickle = path.suffix.lower() in PICKLES
    if not is_pickle and not _has_entries(path):
        return None
    entries = read_plain_pickle(path) if is_pickle else read_json(path, largest=LARGEST_BYTES)
    if isinstance(entries, dict):
        entries = next((entries[name] for name in LISTS if name in entries), entries)
    entries = entries if isinstance(entries, list) else [entries]
    rigs = [_cameras(entry, f"{path}: entry {index}") for index, entry in enumerate(entries)]
    if not rigs:
        raise InputError(f"{path}: has no entries")
    for index, rig in enumerate(rigs):
        if rig.keys() != rigs[0].keys() or any(_differ(rig[name], rigs[0][name]) for name in rig):
            raise InputError(f"{path}: entry {index} has another rig than entry 0: keep those of this drive")
    return cameras_of(rigs[0], path)


def _has_entries(path: Path) -> bool:
    if path.suffix.lower() != ".json" or not path.is_file():
        return False
    with open_regular(path) as file:
        head = file.read(HEAD_BYTES)
    named = {name for name in (*LISTS, "cams", "images", "cam_intrinsic") if f'"{name}"'.encode() in head}
    return not named.isdisjoint(LISTS) or len(named) > 1


def _differ(camera: dict[str, Any], other: dict[str, Any]) -> bool:
    return camera.keys() != other.keys() or any(
        not np.allclose(camera[key], other[key], rtol=1e-4, atol=SAME_M) for key in camera
    )


def _cameras(entry: Any, where: str) -> dict[str, dict[str, Any]]:
    cameras = entry.get("cams", entry.get("images")) if isinstance(entry, dict) else None
    if not isinstance(cameras, dict) or not cameras or not all(isinstance(each, dict) for each in cameras.values()):
        raise InputError(f'{where}: has no cameras (expected "cams" or "images" with one object for each camera)')
    points = entry.get("lidar_points")
    lidar = {**entry, **points} if isinstance(points, dict) else entry
    ego_from_lidar = _transform(lidar, where, "lidar2ego")
    return {str(name): _camera(camera, ego_from_lidar, f"{where}: camera {name}") for name, camera in cameras.items()}


def _camera(camera: dict[str, Any], ego_from_lidar: Array | None, where: str) -> dict[str, Any]:
    """The names and values of a camera that `cameras_of` reads."""
    image_from_lidar, camera_from_lidar = (_transform(camera, where, name) for name in ("lidar2img", "lidar2cam"))
    intrinsics = _transform(camera, where, "cam_intrinsic", "cam2img")
    ego_from_camera = _transform(camera, where, "sensor2ego", "cam2ego")
    lidar_from_camera = _transform(camera, where, "sensor2lidar")
    if camera_from_lidar is not None:
        lidar_from_camera = inverse(camera_from_lidar)
    if image_from_lidar is not None and (intrinsics is None or lidar_from_camera is None):
        intrinsics, lidar_from_camera = _split(image_from_lidar)
    if intrinsics is None:
        raise InputError(f"{where}: has no intrinsics (expected cam_intrinsic, cam2img or lidar2img)")
    made: dict[str, Any] = {key: camera[key] for key in ("width", "height") if key in camera}
    made["K"] = intrinsics[:3, :3].tolist()
    if ego_from_camera is None and lidar_from_camera is not None and ego_from_lidar is not None:
        ego_from_camera = ego_from_lidar @ lidar_from_camera
    if ego_from_camera is not None:
        return made | {"ego_from_camera": ego_from_camera.tolist()}
    return made if lidar_from_camera is None else made | {"lidar2cam": inverse(lidar_from_camera).tolist()}


def _transform(owner: dict[str, Any], where: str, *names: str) -> Array | None:
    """(4, 4) of the first NAME, 3x3 to 4x4 numbers, or NAME_rotation and NAME_translation; None where there is none."""
    for name in names:
        if owner.get(name) is not None:
            numbers = array_of_numbers(owner[name])
            if numbers is None or numbers.shape not in ((3, 3), (3, 4), (4, 4)) or not np.isfinite(numbers).all():
                raise InputError(f"{where}: {name}: expected 3x3 or 4x4 finite numbers")
            matrix = np.eye(4)
            matrix[: numbers.shape[0], : numbers.shape[1]] = numbers
            return matrix
        rotation, translation = (array_of_numbers(owner.get(f"{name}_{key}")) for key in ("rotation", "translation"))
        if rotation is not None and translation is not None:
            if rotation.size not in (4, 9) or translation.size != 3:
                expected = "w, x, y, z or 3x3 numbers, and three of a translation"
                raise InputError(f"{where}: {name}_rotation: expected {expected}")
            turned = rotation_from_quaternion(rotation.ravel()) if rotation.size == 4 else rotation.reshape(3, 3)
            return rigid(translation.ravel(), turned)
    return None


def _split(image_from_lidar: Array) -> tuple[Array, Array]:
    """(4, 4) intrinsics and lidar_from_camera of a projection."""
    triangle, rotation = rq(image_from_lidar[:3, :3])
    signs = np.diag(np.sign(np.diag(triangle)))
    triangle, rotation = triangle @ signs, signs @ rotation
    intrinsics, camera_from_lidar = np.eye(4), rigid(np.linalg.solve(triangle, image_from_lidar[:3, 3]), rotation)
    intrinsics[:3, :3] = triangle / triangle[2, 2]
    return intrinsics, inverse(camera_from_lidar)


LARGEST_PICKLE, MOST_OPCODES = 256 * MIB, 3_000_000
NUMBERS = ("f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1")


class StoredType:
    """Stands for the type of an array's numbers."""

    def __init__(self, name: object, *_: object) -> None:
        self.name, self.order = str(name), "<"

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = str(state[1])

    def numbers(self, stored: object) -> Array | None:
        """(N,) numbers of bytes; None for other types, such as texts."""
        if self.name not in NUMBERS or not isinstance(stored, (bytes, bytearray)):
            return None
        return np.frombuffer(stored, dtype=(">" if self.order == ">" else "<") + self.name)


class StoredArray:
    """Stands for an array. `numbers` is None for one without numbers."""

    numbers: Array | None = None

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, kind, is_fortran, stored = state
        numbers = kind.numbers(stored)
        self.numbers = None if numbers is None else numbers.reshape(shape, order="F" if is_fortran else "C")

    def __array__(self, dtype: Any = None, copy: Any = None) -> Array:
        return np.array(self.numbers, dtype=dtype)


def _of_buffer(stored: Any, kind: StoredType, shape: Any, order: str) -> StoredArray:
    array = StoredArray()
    array.__setstate__((1, shape, kind, order == "F", bytes(stored)))
    return array


def _scalar(kind: StoredType, stored: Any) -> Any:
    numbers = kind.numbers(stored)
    return None if numbers is None else numbers[0].item()


def _encode(text: str, _: object) -> bytes:
    return text.encode("latin1")


# What stands for the classes and functions that a pickle of NumPy's names.
STAND_INS: dict[tuple[str, str], Any] = {
    ("_codecs", "encode"): _encode, ("collections", "OrderedDict"): OrderedDict,
    ("numpy", "dtype"): StoredType, ("numpy", "ndarray"): StoredArray,
}  # fmt: skip
for core in ("numpy.core", "numpy._core"):
    STAND_INS[f"{core}.multiarray", "_reconstruct"] = lambda *_: StoredArray()
    STAND_INS[f"{core}.multiarray", "scalar"] = _scalar
    STAND_INS[f"{core}.numeric", "_frombuffer"] = _of_buffer


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in STAND_INS:
            raise pickle.UnpicklingError(f"it calls {module}.{name}, and was not read further")
        return STAND_INS[module, name]


def read_plain_pickle(path: Path) -> Any:
    """The contents of a pickle. Arrays are `StoredArray`s, which `numpy.array` takes. Raises InputError."""
    content = read_bytes(path, LARGEST_PICKLE)
    try:
        for count, (opcode, argument, _) in enumerate(pickletools.genops(content)):
            if count > MOST_OPCODES:
                raise pickle.UnpicklingError("it has too many values: keep the entries of this drive")
            if "PUT" in opcode.name and isinstance(argument, int) and argument > count:  # it would take all memory
                raise pickle.UnpicklingError("it is damaged")
        return _Unpickler(io.BytesIO(content)).load()
    except Exception as error:  # a damaged pickle fails in many ways
        raise InputError(f"{path}: cannot be read as a pickle ({reason_of(error)[:200]})") from None
