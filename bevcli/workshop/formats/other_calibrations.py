"""Calibrations of COLMAP (as text), nerfstudio (transforms.json) and KITTI.

COLMAP and nerfstudio have poses of images. They are those of the cameras on the vehicle where each camera has only one;
in a reconstruction of a drive the cameras move.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array, inverse, rigid, rotation_from_quaternion
from bevcli.parsing.documents import read_json
from bevcli.parsing.files import MIB, read_text
from bevcli.sequences.files.json_fields import parse_numbers, require
from bevcli.workshop.formats.camera_poses import Cameras, Direction, StatedCamera, StatedPose
from bevcli.workshop.formats.named_calibration import COEFFICIENTS, lens_fields, lens_of, number_of

KITTI_FILES = ("calib_cam_to_cam.txt", "calib.txt")
LARGEST_TEXT = 64 * MIB
NO_CAMERA = ("", ".", "images")  # folders that are not named after a camera
SAME_FOCAL = 1.05  # ratio of focal lengths that a program finds for images of one camera
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
NERF_MODELS = {
    "opencv": "plumb_bob",
    "pinhole": "plumb_bob",
    "simple_pinhole": "plumb_bob",
    "opencv_fisheye": "fisheye",
}
# KITTI's Velodyne is 0.76 m ahead of the rear axle and 1.73 m above the road (the data set's drawing of the vehicle).
EGO_FROM_VELODYNE = rigid((0.76, 0.0, 1.73))


def is_colmap(path: Path) -> bool:
    """True for cameras.txt, and for a folder that has it. Raises InputError for a folder with binary files only."""
    if not path.is_dir():
        return path.name == "cameras.txt"
    if _colmap_folder(path, "cameras.txt") is None and (folder := _colmap_folder(path, "cameras.bin")) is not None:
        raise InputError(
            f"{folder / 'cameras.bin'}: is binary: convert it (`colmap model_converter --output_type TXT …`)"
        )
    return _colmap_folder(path, "cameras.txt") is not None


def _colmap_folder(path: Path, file: str) -> Path | None:
    return next((path / inner for inner in ("", "sparse/0", "sparse") if (path / inner / file).exists()), None)


def read_colmap(path: Path) -> Cameras:
    """The cameras of COLMAP's cameras.txt. images.txt has their poses and names, those of the images' folders."""
    folder = (_colmap_folder(path, "cameras.txt") if path.is_dir() else path.parent) or path
    by_id = {}
    for number, line in _lines_of(folder / "cameras.txt"):
        words, where = line.split(), f"{folder / 'cameras.txt'}: line {number}"
        numbers = [number_of(word) for word in words[2:]]
        if len(words) < 4 or None in numbers:
            raise InputError(f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
        if words[0] in by_id:
            raise InputError(f"{where}: camera {words[0]:.60} is in the file twice: keep one")
        by_id[words[0]] = replace(_colmap_camera(words[1], numbers[2:], where), size=(numbers[0], numbers[1]))
    poses, ids = dict[str, list[Array]](), dict[str, dict[str, None]]()
    images = folder / "images.txt"
    lines = list(_lines_of(images, keep_empty=True)) if images.exists() else []
    entries = [line.split(maxsplit=9) for _, line in lines[::2]]  # the other lines are points
    camera_of = {words[9]: words[8] for words in entries if len(words) == 10}
    names = _names_of_images(
        {path: f"camera{key}" for path, key in camera_of.items()},
        each_its_own=len(set(camera_of.values())) == len(camera_of) > 1,
    )
    for number, line in lines[::2]:
        words = line.split(maxsplit=9)
        numbers = [number_of(word) for word in words[:8]]
        if len(words) < 10 or None in numbers or words[8] not in by_id:
            raise InputError(f"{images}: line {number}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
        _, *pose_numbers = np.array(numbers, dtype=np.float64)
        pose = rigid(pose_numbers[4:], rotation_from_quaternion(pose_numbers[:4]))
        name = names[words[9]]
        poses.setdefault(name, []).append(pose)
        ids.setdefault(name, {})[words[8]] = None
    if not poses:
        return {f"camera{key}": camera for key, camera in by_id.items()}
    return {
        name: _posed(
            _one_camera([by_id[key] for key in ids[name]], f"{folder / 'cameras.txt'}: camera {name}"),
            of_camera,
            images.name,
            "camera_from_ego",
            "optical",
        )
        for name, of_camera in poses.items()
    }


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


def _posed(camera: StatedCamera, poses: list[Array], name: str, direction: Direction, axes: str) -> StatedCamera:
    """The camera with its pose, where the file has only one place of it."""
    if any(not np.allclose(pose, poses[0], atol=1e-3) for pose in poses):
        return replace(camera, moves=True)
    return replace(camera, pose=StatedPose({"": poses[0]}, direction, axes=axes, name=name))


def _lines_of(path: Path, *, keep_empty: bool = False) -> Iterator[tuple[int, str]]:
    """Lines of a text with their numbers, without comments."""
    for number, line in enumerate(read_text(path, LARGEST_TEXT).splitlines(), 1):
        if (line.strip() or keep_empty) and not line.startswith("#"):
            yield number, line


def _names_of_images(images: Mapping[str, str], *, each_its_own: bool) -> dict[str, str]:
    """The camera of each image, by its path: its folder; without one, its name without a number.

    images: path -> the camera where neither names one. each_its_own: each image has intrinsics of its own.
    """
    stems = {path: re.sub(r"[_. -]*\d+$", "", Path(path).stem) for path in images
             if Path(path).parent.name in NO_CAMERA}  # fmt: skip
    are_cameras = each_its_own and all(stems.values()) and len(set(stems.values())) == len(stems)
    other = stems if are_cameras else images
    return {path: other[path] if path in stems else Path(path).parent.name for path in images}


def _one_camera(cameras: list[StatedCamera], where: str) -> StatedCamera:
    """The camera whose images have intrinsics of their own: the median ones, where they are about equal."""
    matrices = np.array([camera.intrinsics for camera in cameras])
    focal = matrices[:, 0, 0]
    if (
        focal.max() > SAME_FOCAL * focal.min()
        or len({str((each.distortion or {}).get("model")) for each in cameras}) > 1
    ):
        raise InputError(
            f"{where}: its images have focal lengths of {focal.min():.0f} to {focal.max():.0f} px: state one camera "
            "for each folder (COLMAP: --ImageReader.single_camera_per_folder 1), or put the images of each in a folder"
        )
    return replace(cameras[0], intrinsics=np.median(matrices, axis=0).tolist())


def is_nerfstudio(path: Path) -> bool:
    """True for transforms.json, and for a folder that has it."""
    file = path / "transforms.json" if path.is_dir() else path
    if file.suffix.lower() != ".json" or not file.is_file():
        return False
    document = read_json(file)
    return isinstance(document, dict) and "frames" in document and "cameras" not in document


def read_nerfstudio(path: Path) -> Cameras:
    """The cameras of nerfstudio's transforms.json, by the folders of the images; camera axes are those of OpenGL."""
    file = path / "transforms.json" if path.is_dir() else path
    document = read_json(file)
    frames = document.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames) or not frames:
        raise InputError(
            f'{file}: "frames" is missing (expected a list of objects with file_path and transform_matrix)'
        )
    paths = [str(frame.get("file_path", "")) for frame in frames]
    names = _names_of_images(dict.fromkeys(paths, "camera"), each_its_own=all("fl_x" in frame for frame in frames))
    entries: dict[str, list[dict[str, Any]]] = {}
    poses: dict[str, list[Array]] = {}
    for index, frame in enumerate(frames):
        name, where = names[paths[index]], f"{file}: frame {index}"
        entries.setdefault(name, []).append({**document, **frame})
        poses.setdefault(name, []).append(require(parse_numbers, frame, "transform_matrix", (4, 4), where=where))
    made = {}
    for name, of_camera in entries.items():
        where = f"{file}: camera {name}"
        made[name] = _one_camera([_nerf_camera(entry, where) for entry in of_camera], where)
    return {
        name: _posed(camera, poses[name], "transform_matrix", "ego_from_camera", "opengl")
        for name, camera in made.items()
    }


def _nerf_camera(entry: Mapping[str, Any], where: str) -> StatedCamera:
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


def read_kitti(path: Path) -> Cameras:
    """The rectified cameras of KITTI: image_02 of calib_cam_to_cam.txt, image_2 of P2 in other files.

    The origin is on the road, below the rear axle. Poses need Tr_velo_to_cam, Tr, or calib_velo_to_cam.txt beside.
    """
    file = next((path / name for name in KITTI_FILES if (path / name).exists()), path)
    rows = _kitti_rows(file)
    camera0_from_velodyne = _camera0_from_velodyne(rows, file)
    rectification = next((_row(rows, key, 9, file) for key in ("R_rect_00", "R0_rect", "R_rect") if key in rows), None)
    rectified_from_camera0 = rigid(rotation=None if rectification is None else rectification.reshape(3, 3))
    cameras: Cameras = {}
    for key in rows:
        if (match := re.fullmatch(r"P(_rect_0)?(\d)", key)) is None:
            continue
        projection = _row(rows, key, 12, file).reshape(3, 4)
        matrix = projection[:, :3]
        if abs(np.linalg.det(matrix)) < 1e-9:
            raise InputError(f"{file}: {key}: is singular (expected the projection matrix of a camera)")
        pose = None
        if camera0_from_velodyne is not None:
            camera_from_rectified = rigid(np.linalg.solve(matrix, projection[:, 3]))
            camera_from_velodyne = camera_from_rectified @ rectified_from_camera0 @ camera0_from_velodyne
            pose = StatedPose({"": EGO_FROM_VELODYNE @ inverse(camera_from_velodyne)}, "ego_from_camera", exact=True)
        size = f"S_rect_0{match[2]}"
        cameras[f"image_{'0' if match[1] else ''}{match[2]}"] = StatedCamera(
            (matrix / matrix[2, 2]).tolist(),
            (rows[size][0], rows[size][-1]) if size in rows else None,
            {"model": "none"},
            pose,
        )
    if not cameras:
        raise InputError(f"{file}: has no projection matrix (expected P2, or P_rect_02, of KITTI)")
    return cameras


def _camera0_from_velodyne(rows: Mapping[str, Array], file: Path) -> Array | None:
    """(4, 4), of the file or of that beside it; None if there is none."""
    name = next((key for key in ("Tr_velo_to_cam", "Tr", "Tr_velo_cam") if key in rows), None)
    if name is not None:
        matrix = _row(rows, name, 12, file).reshape(3, 4)
        return rigid(matrix[:, 3], matrix[:, :3])
    beside = file.parent / "calib_velo_to_cam.txt"
    if not beside.exists():
        return None
    return kitti_transform(beside)


def kitti_transform(path: Path) -> Array:
    """(4, 4) of R and T in one of KITTI's files: calib_imu_to_velo.txt has velodyne_from_imu. Raises InputError."""
    rows = _kitti_rows(path)
    return rigid(_row(rows, "T", 3, path), _row(rows, "R", 9, path).reshape(3, 3))


def _kitti_rows(path: Path) -> dict[str, Array]:
    rows = {}
    for number, line in _lines_of(path):
        key, colon, text = line.partition(":")
        numbers = [number_of(word) for word in text.split()]
        if not colon:
            raise InputError(f"{path}: line {number}: expected NAME: NUMBERS, as in KITTI")
        if numbers and None not in numbers:
            if key.strip() in rows:
                raise InputError(f"{path}: line {number}: {key.strip():.60} is in the file twice: keep one")
            rows[key.strip()] = np.array(numbers, dtype=np.float64)
    return rows


def _row(rows: Mapping[str, Array], key: str, count: int, path: Path) -> Array:
    row = rows.get(key)
    if row is None or row.size != count or not np.isfinite(row).all():
        raise InputError(f"{path}: {key}: expected {count} finite numbers, found {0 if row is None else row.size}")
    return row
