"""Calibrations of COLMAP (as text), nerfstudio (transforms.json), VINS-Fusion and information files of mmdetection3d.

COLMAP and nerfstudio have poses of images. They are those of the cameras on the vehicle where each camera has only one;
in a reconstruction of a drive the cameras move. VINS-Fusion has the poses of the cameras in one file (`body_T_cam0`),
and K and D in those beside it that `cam0_calib` names, of a lens of camodocal.

An information file of BEVDet, BEVFormer and mmdetection3d, `nuscenes_infos_val.pkl` or the same as JSON, has the
cameras of a sample: `cams` with `sensor2ego_rotation` and `cam_intrinsic`, or, from mmdetection3d 1.1 on, `images` with
`cam2ego` and `cam2img`. Where only the lidar is named (`sensor2lidar_rotation`, `lidar2cam`), its pose on
the vehicle (`lidar2ego`) is needed, or the rig is that of the lidar. Of a pickle, plain values and NumPy's arrays of
numbers are read. Nothing is called or imported.
"""

import io
import pickle
import pickletools
import re
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array, inverse, rigid, rotation_from_quaternion
from bevcli.parsing.documents import read_json
from bevcli.parsing.files import MIB, open_regular, read_bytes, read_text
from bevcli.printing import reason_of
from bevcli.sequences.files.json_fields import array_of_numbers, parse_numbers, require
from bevcli.workshop.formats.camera_poses import Cameras, StatedCamera, StatedPose
from bevcli.workshop.formats.markup import YAML_BYTES, read_yaml
from bevcli.workshop.formats.named_calibration import (
    COEFFICIENTS,
    cameras_of,
    files_in,
    lens_fields,
    lens_of,
)
from bevcli.workshop.formats.pose_table import number_of

LARGEST_TEXT = 64 * MIB
NO_CAMERA = ("", ".", "images")  # folders that are not named after a camera
SAME_FOCAL = 1.05  # ratio of focal lengths that a program finds for images of one camera
Image = tuple[str, str, StatedCamera, Array]  # path, camera where the path names none, intrinsics, and pose (4, 4)
PIXEL_CENTER = 0.5  # COLMAP and nerfstudio: coordinates of the centre of the top left pixel; 0 here
# COLMAP's models: the number of focal lengths, the model of the lens, and the coefficients in the file's order.
COLMAP_MODELS = {
    "SIMPLE_PINHOLE": (1, "brown_conrady", ""),
    "PINHOLE": (2, "brown_conrady", ""),
    "SIMPLE_RADIAL": (1, "brown_conrady", "k1"),
    "RADIAL": (1, "brown_conrady", "k1 k2"),
    "OPENCV": (2, "brown_conrady", "k1 k2 p1 p2"),
    "FULL_OPENCV": (2, "brown_conrady", "k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_RADIAL_FISHEYE": (1, "kannala_brandt", "k1"),
    "RADIAL_FISHEYE": (1, "kannala_brandt", "k1 k2"),
    "OPENCV_FISHEYE": (2, "kannala_brandt", "k1 k2 k3 k4"),
}
NERF_MODELS = {**dict.fromkeys(("opencv", "pinhole", "simple_pinhole"), "plumb_bob"), "opencv_fisheye": "fisheye"}
# VINS-Fusion's names of files, and the lens KANNALA_BRANDT of camodocal with the names here.
VINS_CALIBRATION, VINS_LINE = re.compile(r"cam(\d+)_calib"), re.compile(rb"^cam\d+_calib\s*:", re.MULTILINE)
KANNALA_BRANDT = {"mu": "fx", "mv": "fy", "u0": "cx", "v0": "cy", "k2": "k1", "k3": "k2", "k4": "k3", "k5": "k4"}
# Information files.
LARGEST_BYTES = 1024 * MIB
PICKLES = (".pkl", ".pickle")
LISTS = ("infos", "data_list")
HEAD_BYTES = 4096  # of a JSON file, in which the name of a list stands
SAME_M = 1e-3


def read_colmap(path: Path) -> Cameras | None:
    """The cameras of COLMAP's cameras.txt, of which images.txt has the poses; None for another calibration.

    Their names are those of the images' folders. Raises InputError, also for a folder with binary files only.
    """
    inside = [path / name for name in ("", "sparse/0", "sparse")] if path.is_dir() else [path.parent]
    inside = inside if path.is_dir() or path.name == "cameras.txt" else []
    folder = next((each for each in inside if (each / "cameras.txt").exists()), None)
    binary = next((file for each in inside if (file := each / "cameras.bin").exists()), None)
    if folder is None and binary is not None:
        raise InputError(f"{binary}: is binary: convert it (`colmap model_converter --output_type TXT …`)")
    if folder is None:
        return None
    by_id = {}
    for number, line in lines_of(folder / "cameras.txt"):
        words, where = line.split(), f"{folder / 'cameras.txt'}: line {number}"
        numbers = [number_of(word) for word in words[2:]]
        if len(words) < 4 or None in numbers:
            raise InputError(f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
        if words[0] in by_id:
            raise InputError(f"{where}: camera {words[0]:.60} is in the file twice: keep one")
        by_id[words[0]] = replace(_colmap_camera(words[1], numbers[2:], where), size=(numbers[0], numbers[1]))
    file, images = folder / "images.txt", list[Image]()
    lines = list(lines_of(file, keep_empty=True)) if file.exists() else []
    for number, line in lines[::2]:  # the other lines are points
        words = line.split(maxsplit=9)
        numbers = [number_of(word) for word in words[:8]]
        if len(words) < 10 or None in numbers or words[8] not in by_id:
            raise InputError(f"{file}: line {number}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
        _, *pose_numbers = np.array(numbers, dtype=np.float64)
        pose = rigid(pose_numbers[4:], rotation_from_quaternion(pose_numbers[:4]))
        images.append((words[9], f"camera{words[8]}", by_id[words[8]], pose))
    if not images:
        return {f"camera{key}": camera for key, camera in by_id.items()}
    camera_of = {path: camera for path, camera, *_ in images}
    each_its_own = len(set(camera_of.values())) == len(camera_of) > 1
    stated = StatedPose({}, "camera_from_ego", axes="optical", name=file.name)
    return _cameras_of_images(folder / "cameras.txt", images, stated, each_its_own=each_its_own)


def _colmap_camera(model: str, parameters: list[Any], where: str) -> StatedCamera:
    focals, lens, names = COLMAP_MODELS.get(model, (0, "", ""))
    count = focals + 2 + len(names.split())
    if not focals or len(parameters) != count:
        expected = ", ".join(COLMAP_MODELS) if not focals else f"{count} parameters of {model}"
        raise InputError(
            f"{where}: the camera model {model:.40} with {len(parameters)} parameters is unknown (expected {expected})"
        )
    fx, fy, (cx, cy) = parameters[0], parameters[focals - 1], parameters[focals : focals + 2]
    parameter_of = dict(zip(names.split(), parameters[focals + 2 :], strict=True))
    coefficients = [parameter_of.get(name, 0.0) for name in COEFFICIENTS[lens]] if lens else []
    matrix = [[fx, 0, cx - PIXEL_CENTER], [0, fy, cy - PIXEL_CENTER], [0, 0, 1]]
    return StatedCamera(matrix, None, lens_fields(lens, coefficients, where))


def lines_of(path: Path, *, keep_empty: bool = False) -> Iterator[tuple[int, str]]:
    """Lines of a text with their numbers, without comments."""
    for number, line in enumerate(read_text(path, LARGEST_TEXT).splitlines(), 1):
        if (line.strip() or keep_empty) and not line.startswith("#"):
            yield number, line


def _cameras_of_images(file: Path, images: Sequence[Image], pose: StatedPose, *, each_its_own: bool) -> Cameras:
    """The cameras of images: by the folder of each; without one, by its name without a number.

    pose: without its matrix, which it has where a camera has only one place. each_its_own: each image has intrinsics of
    its own.
    """
    stems = {path: re.sub(r"[_. -]*\d+$", "", Path(path).stem) for path, *_ in images
             if Path(path).parent.name in NO_CAMERA}  # fmt: skip
    are_cameras = each_its_own and all(stems.values()) and len(set(stems.values())) == len(stems)
    groups: dict[str, list[tuple[StatedCamera, Array]]] = {}
    for path, other, camera, matrix in images:
        name = Path(path).parent.name if path not in stems else stems[path] if are_cameras else other
        groups.setdefault(name, []).append((camera, matrix))
    cameras: Cameras = {}
    for name, group in groups.items():
        camera = _one_camera(list({id(camera): camera for camera, _ in group}.values()), f"{file}: camera {name}")
        first, moves = group[0][1], any(not np.allclose(matrix, group[0][1], atol=1e-3) for _, matrix in group)
        cameras[name] = replace(camera, pose=None if moves else replace(pose, matrices={"": first}), moves=moves)
    return cameras


def _one_camera(cameras: list[StatedCamera], where: str) -> StatedCamera:
    """The camera whose images have intrinsics of their own: the median ones, where they are about equal."""
    matrices = np.array([camera.intrinsics for camera in cameras])
    focal = matrices[:, 0, 0]
    lenses = {str((camera.distortion or {}).get("model")) for camera in cameras}
    if focal.max() > SAME_FOCAL * focal.min() or len(lenses) > 1:
        raise InputError(
            f"{where}: its images have focal lengths of {focal.min():.0f} to {focal.max():.0f} px: state one camera "
            "for each folder (COLMAP: --ImageReader.single_camera_per_folder 1), or put the images of each in a folder"
        )
    return replace(cameras[0], intrinsics=np.median(matrices, axis=0).tolist())


def read_nerfstudio(path: Path) -> Cameras | None:
    """The cameras of nerfstudio's transforms.json, by the folders of the images; None for another calibration.

    The camera axes are those of OpenGL. Raises InputError.
    """
    file = path / "transforms.json" if path.is_dir() else path
    document = read_json(file) if file.suffix.lower() == ".json" and file.is_file() else None
    if not isinstance(document, dict) or "frames" not in document or "cameras" in document:
        return None
    frames = document.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames) or not frames:
        expected = "a list of objects with file_path and transform_matrix"
        raise InputError(f'{file}: "frames" is missing (expected {expected})')
    images = list[Image]()
    for index, frame in enumerate(frames):
        where = f"{file}: frame {index}"
        matrix = require(parse_numbers, frame, "transform_matrix", (4, 4), where=where)
        images.append((str(frame.get("file_path", "")), "camera", _nerf_camera({**document, **frame}, where), matrix))
    pose = StatedPose({}, "ego_from_camera", axes="opengl", name="transform_matrix")
    return _cameras_of_images(file, images, pose, each_its_own=all("fl_x" in frame for frame in frames))


def _nerf_camera(entry: Mapping[str, Any], where: str) -> StatedCamera:
    if "fl_x" not in entry and "camera_angle_x" in entry:
        raise InputError(f'{where}: "fl_x" is missing: add w / 2 / tan(camera_angle_x / 2), and w, h, cx and cy')
    fx, cx, cy = (require(parse_numbers, {key: [entry[key]] if key in entry else None}, key, (1,), where=where)[0]
                  for key in ("fl_x", "cx", "cy"))  # fmt: skip
    matrix = [[fx, 0, cx - PIXEL_CENTER], [0, entry.get("fl_y", fx), cy - PIXEL_CENTER], [0, 0, 1]]
    model = str(entry.get("camera_model", "OPENCV")).lower()
    if model not in NERF_MODELS:
        expected = ", ".join(NERF_MODELS).upper()
        raise InputError(f"{where}: camera_model {model:.40} is not supported (expected {expected})")
    lens = lens_of(
        {key: entry[key] for names in COEFFICIENTS.values() for key in names if key in entry}, NERF_MODELS[model], where
    )
    size = (entry.get("w"), entry.get("h"))
    return StatedCamera(matrix, size if None not in size else None, lens)


def read_vins_fusion(path: Path) -> Cameras | None:
    """The cameras cam0, cam1 of VINS-Fusion; None for another calibration.

    path: the file that names others, or a folder, of whose files that with most cameras is taken. Raises InputError.
    """
    files = [path] if path.is_file() else files_in(path)
    files = [file for file in files if file.suffix.lower() in (".yaml", ".yml")]
    files = [file for file in files if VINS_LINE.search(read_bytes(file, YAML_BYTES))]
    if not files:
        return None
    rigs = [_vins_cameras(file) for file in files]
    most = max(map(len, rigs))
    rig, *others = [rig for rig in rigs if len(rig) == most]
    if any(other != rig for other in others):
        names = ", ".join(file.name for file in files)
        raise InputError(f"{path}: has several configurations ({names}): pass one of these files")
    return cameras_of(rig, path)


def _vins_cameras(main: Path) -> dict[str, Any]:
    document, cameras = read_yaml(main), dict[str, Any]()
    if not isinstance(document, dict):
        raise InputError(f"{main}: is no mapping (expected cam0_calib, body_T_cam0 and so on)")
    for key, name in document.items():
        if (match := VINS_CALIBRATION.fullmatch(str(key))) is not None:
            camera = read_yaml(main.parent / Path(str(name)).name)
            if not isinstance(camera, dict):
                raise InputError(f"{main}: {key}: {name}: is no mapping (expected K and D of a camera)")
            pose = f"body_T_cam{match[1]}"
            stated = {pose: document[pose]} if pose in document else {}
            cameras[f"cam{match[1]}"] = {**_in_own_names(camera), **stated}
    return cameras


def _in_own_names(camera: dict[str, Any]) -> dict[str, Any]:
    numbers = camera.get("projection_parameters")
    if str(camera.get("model_type")).upper() != "KANNALA_BRANDT" or not isinstance(numbers, dict):
        return camera
    renamed = {new: numbers.get(name) for name, new in KANNALA_BRANDT.items()}
    return {**camera, "projection_parameters": None, **renamed}


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
    intrinsics = _transform(camera, where, "cam_intrinsic", "cam2img")
    if intrinsics is None:
        raise InputError(f"{where}: has no intrinsics (expected cam_intrinsic or cam2img)")
    made: dict[str, Any] = {key: camera[key] for key in ("width", "height") if key in camera}
    made["K"] = intrinsics[:3, :3].tolist()
    ego_from_camera = _transform(camera, where, "sensor2ego", "cam2ego")
    lidar_from_camera, camera_from_lidar = (_transform(camera, where, name) for name in ("sensor2lidar", "lidar2cam"))
    if camera_from_lidar is None and lidar_from_camera is not None:
        camera_from_lidar = inverse(lidar_from_camera)
    if ego_from_camera is None and camera_from_lidar is not None and ego_from_lidar is not None:
        ego_from_camera = ego_from_lidar @ inverse(camera_from_lidar)
    stated = {"ego_from_camera": ego_from_camera} if ego_from_camera is not None else {"lidar2cam": camera_from_lidar}
    return made | {name: pose.tolist() for name, pose in stated.items() if pose is not None}


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
