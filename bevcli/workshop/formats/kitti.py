"""KITTI: drives as they lie on disk, calibration, poses and labels, which are exported, too.

Drives are those of odometry (`sequences/00`) and raw (`2011_09_26/2011_09_26_drive_0001_sync`). Calibration, times and
poses are found where the data set has them; options replace them. The folder `oxts` has the poses of the vehicle from
GPS and IMU, a file for each time. Labels are a tracking file of a drive, or a folder with a file for each frame.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.boxes import BOX_EDGES, Boxes3D
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass
from bevcli.geometry.transforms import EAST_DEG, Array, GeoOrigin, Pose, apply, inverse, rigid, wrap_angle
from bevcli.parsing.files import MIB, is_there, read_text
from bevcli.printing import counted
from bevcli.sequences.files.boxes_file import BoxesFile
from bevcli.sequences.files.calibration_file import CALIBRATION, read_calibration
from bevcli.sequences.files.ego_motion_file import ReadPoses
from bevcli.sequences.native import FolderOptions
from bevcli.sequences.native.folder import FolderDrive
from bevcli.sequences.options import InputOptions
from bevcli.workshop.formats import ExportOptions, LabelOptions
from bevcli.workshop.formats.camera_poses import Cameras, StatedCamera, StatedPose
from bevcli.workshop.formats.label_readings import LARGEST_RADIANS, USUAL, LabelledFrame, Labels
from bevcli.workshop.formats.name_times import read_times
from bevcli.workshop.formats.other_calibrations import lines_of
from bevcli.workshop.formats.pose_readings import product, quaternions_of_angles, rotated
from bevcli.workshop.formats.pose_table import AS_TEXT, number_of
from bevcli.writing import write_whole

KITTI_FILES = ("calib_cam_to_cam.txt", "calib.txt", "perspective.txt")  # the last one of KITTI-360
CAMERAS_TO_POSE = "calib_cam_to_pose.txt"  # of KITTI-360, beside it
# The Velodyne is 0.76 m ahead of the rear axle and 1.73 m above the road (the data set's drawing of the vehicle).
EGO_FROM_VELODYNE = rigid((0.76, 0.0, 1.73))
OXTS_NUMBERS = 30  # of a file: latitude, longitude, altitude, roll, pitch, yaw and so on
LARGEST_BYTES = 256 * MIB
IGNORED = "DontCare"
# The words of a line after frame and track: type, truncated, occluded, alpha, the box in the image, then height, width,
# length, the middle of the bottom x, y, z in the frame of the camera, and rotation_y. Predictions add a score.
WORDS = (15, 16)
NAMES = ("height", "width", "length", "x", "y", "z", "rotation_y")
LabelRow = tuple[str, list[str], str]  # where it is, its words from the type on, and its track
LABELLED = ("image_02", "image_2")  # the camera of KITTI's labels
OCCLUSION_UNKNOWN = 3
NEAR_M = 0.1  # box edges are clipped at this depth


def read_kitti_labels(path: Path, rig: CameraRig, options: LabelOptions) -> Labels:
    """The boxes of a tracking file, or of a folder with files NNNNNN.txt. Raises InputError that names the line.

    They are in the frame of the camera `labels_camera`; by default of image_2, or of any camera: the images decide.
    """
    cameras = _ahead_first(rig)
    name = options.labels_camera or next((name for name in LABELLED if name in rig.names), None)
    if name is not None and name not in rig.names:
        raise InputError(
            f"`labels_camera={name}` (`--labels-camera`): is not in the rig (expected one of {', '.join(rig.names)})"
        )
    cameras = cameras if name is None else [rig[name]]
    rows = _rows_of_folder(path) if path.is_dir() else _rows_of_tracking_file(path)
    frames = tuple(_labelled(index, of_frame, cameras) for index, of_frame in rows.items())
    return Labels(USUAL, frames, lists_empty=path.is_dir())


def _ahead_first(rig: CameraRig) -> list[Camera]:
    return sorted(rig.cameras, key=lambda camera: abs(camera.yaw))


def _labelled(index: int, rows: Sequence[LabelRow], cameras: Sequence[Camera]) -> LabelledFrame:
    by_camera = {camera.name: Boxes3D.concatenate(_box(*row, camera) for row in rows) for camera in cameras}
    return LabelledFrame(index, None, by_camera[cameras[0].name], by_camera)


def _rows_of_folder(path: Path) -> dict[int, list[LabelRow]]:
    rows: dict[int, list[LabelRow]] = {}
    for file in sorted(path.glob("*.txt")):
        if not file.stem.isdecimal():
            raise InputError(f"{file}: expected the index of a frame as its name, such as 000042.txt")
        rows[int(file.stem)] = [(where, words, "") for where, words in _lines(file)]
    return rows


def _rows_of_tracking_file(path: Path) -> dict[int, list[LabelRow]]:
    rows: dict[int, list[LabelRow]] = {}
    for where, words in _lines(path):
        if not words[0].isdecimal() or len(words) < 2:
            raise InputError(f'{where}: expected the index of a frame and a track, found "{" ".join(words):.40}"')
        if words[2:3] != [IGNORED]:
            rows.setdefault(int(words[0]), []).append((where, words[2:], words[1]))
    return rows


def _lines(path: Path) -> Iterator[tuple[str, list[str]]]:
    for number, line in enumerate(read_text(path, LARGEST_BYTES).splitlines(), 1):
        if words := line.split():
            yield f"{path}: line {number}", words


def _box(where: str, words: list[str], track: str, camera: Camera) -> Boxes3D:
    """The box of a line in the ego frame; none for an area without labels."""
    if words and words[0] == IGNORED:
        return Boxes3D.empty()
    try:
        height, width, length, x, y, z, rotation_y = (float(word) for word in words[8:15])
    except ValueError:
        raise InputError(
            f"{where}: expected {WORDS[0]} or {WORDS[1]} words from the type on, with {', '.join(NAMES)} as numbers"
        ) from None
    if len(words) not in WORDS or not np.isfinite([height, width, length, x, y, z, rotation_y]).all():
        raise InputError(f"{where}: expected {WORDS[0]} or {WORDS[1]} words, and finite numbers")
    if abs(rotation_y) > LARGEST_RADIANS and min(height, width, length) > 0:
        raise InputError(f"{where}: rotation_y is {rotation_y:g} (expected radians, as KITTI has them): convert it")
    rotation = camera.ego_from_camera[:3, :3]
    heading = rotation @ [np.cos(rotation_y), 0, -np.sin(rotation_y)]
    center = rotation @ [x, y, z] + camera.ego_from_camera[:3, 3] + [0, 0, height / 2]
    return Boxes3D(
        center[None], np.array([[length, width, height]]), np.array([np.arctan2(heading[1], heading[0])]),
        np.full((1, 2), np.nan), np.array([words[0]]), instances=np.array([track]),
    )  # fmt: skip


def is_kitti(path: Path) -> bool:
    """True for a path with KITTI's labels, by its name."""
    return path.suffix.lower() == ".txt" or (path.is_dir() and next(path.glob("*.txt"), None) is not None)


def export_kitti(boxes: BoxesFile, target: Path, options: ExportOptions, source: Path) -> str:
    """Write the labels of a camera, with the calibration that a run and a sequence folder have next to the boxes."""
    path = options.calibration or source.parent / CALIBRATION
    if options.calibration is None and not path.is_file():
        raise InputError(
            "`form=kitti` (`--format kitti`) needs `calibration` (`--calibration`): KITTI labels are in a camera "
            f"frame, and there is no {path} (a run writes it for a drive of one scene)"
        )
    path = path / CALIBRATION if path.is_dir() else path
    rig, name = read_calibration(path), options.camera
    if name is None:
        name = "CAM_FRONT" if "CAM_FRONT" in rig.names else _ahead_first(rig)[0].name
    if name not in rig.names:
        raise InputError(f'{path}: has no camera "{name}" (expected one of {", ".join(rig.names)})')
    labels = write_kitti(boxes, rig[name], rig.ego_from_bev, target)
    return f"{counted(len(boxes.frames), 'frames')}, {counted(labels, 'labels')} of {name}"


def write_kitti(boxes: BoxesFile, camera: Camera, ego_from_bev: Array, folder: Path) -> int:
    """Write label_2/NNNNNN.txt and calib/NNNNNN.txt for every frame; NNNNNN is the frame's index.

    A label is written for each box that is at least partly inside the image without lens distortion. ego_from_bev:
    (4, 4), for boxes in the bev frame, and as the lidar frame of the calibration. Returns the number of labels. Raises
    InputError where frame indices repeat, and OutputError.
    """
    numbers = [frame.stamp.index for frame in boxes.frames]
    if len(set(numbers)) < len(numbers):
        raise InputError("frame indices repeat (KITTI's files are named by them): export each scene separately")
    count, classes = 0, boxes.classes or NUSCENES_CLASSES
    boxes = replace(boxes, ego_from_bev=Pose.from_matrix(ego_from_bev))
    for frame in boxes.frames:
        lines = kitti_labels(boxes.in_ego(frame), camera, classes)
        name = f"{frame.stamp.index:06d}.txt"
        write_whole(folder / "label_2" / name, "".join(f"{line}\n" for line in lines).encode(), parents=True)
        write_whole(folder / "calib" / name, _calibration(camera, ego_from_bev).encode(), parents=True)
        count += len(lines)
    return count


def kitti_labels(
    boxes_ego: Boxes3D, camera: Camera, classes: Mapping[str, ObjectClass] = NUSCENES_CLASSES
) -> list[str]:
    """One line for each box that the camera sees, in the order of the boxes.

    The fields: type, truncated 0 to 1, occluded (3: unknown), alpha, 2D box (left, top, right, bottom) in pixels,
    height, width and length in metres, centre of the bottom face in the camera frame, rotation_y, and the score if
    there is one.
    """
    camera_from_ego = camera.camera_from_ego
    locations = apply(camera_from_ego, boxes_ego.centers - boxes_ego.sizes_lwh * (0, 0, 0.5))
    headings = np.stack([np.cos(boxes_ego.yaws), np.sin(boxes_ego.yaws), np.zeros(len(boxes_ego))], axis=-1)
    headings = headings @ camera_from_ego[:3, :3].T
    rotations_y = np.arctan2(-headings[:, 2], headings[:, 0])
    alphas = wrap_angle(rotations_y - np.arctan2(locations[:, 0], locations[:, 2]))
    lines = []
    for row, corners in enumerate(boxes_ego.corners()):
        seen = _image_box(apply(camera_from_ego, corners), camera)
        if seen is None:
            continue
        rectangle, truncated = seen
        length, width, height = boxes_ego.sizes_lwh[row]
        numbers = [alphas[row], *rectangle, height, width, length, *locations[row], rotations_y[row]]
        label = f"{_kitti_type(str(boxes_ego.classes[row]), classes)} {truncated:.2f} {OCCLUSION_UNKNOWN} "
        score = "" if boxes_ego.scores is None else f" {boxes_ego.scores[row]:.4f}"
        lines.append(label + " ".join(f"{number:.3f}" for number in numbers) + score)
    return lines


def _kitti_type(name: str, classes: Mapping[str, ObjectClass]) -> str:
    """A class's type in KITTI's files, whose columns are parted by spaces; "Misc" for a class that is not known."""
    object_class = classes.get(name)
    return "Misc" if object_class is None else "_".join((object_class.kitti or object_class.name).split())


def _image_box(corners: Array, camera: Camera) -> tuple[Array, float] | None:
    """The rectangle around a box's projection, clipped to the image, and the share of its area that is clipped."""
    points = _in_front_of_camera(corners)
    if not len(points):
        return None
    pixels = (points @ camera.intrinsics.T)[:, :2] / points[:, 2:]
    whole = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
    cut = np.clip(whole, 0, np.array([camera.width - 1, camera.height - 1] * 2))
    area, whole_area = np.prod(cut[2:] - cut[:2]), np.prod(whole[2:] - whole[:2])
    return (cut, float(1 - area / whole_area)) if area > 0 else None


def _in_front_of_camera(corners: Array) -> Array:
    """The corners (8, 3) in front of the camera, and the points where box edges intersect the plane at NEAR_M."""
    a, b = corners[np.array(BOX_EDGES)].swapaxes(0, 1)  # (12, 3) each
    crosses = (a[:, 2] < NEAR_M) != (b[:, 2] < NEAR_M)
    a, b = a[crosses], b[crosses]
    cut = a + ((NEAR_M - a[:, 2]) / (b[:, 2] - a[:, 2]))[:, None] * (b - a)
    return np.concatenate([corners[corners[:, 2] >= NEAR_M], cut])


def _calibration(camera: Camera, ego_from_bev: Array) -> str:
    """KITTI's calibration: P0 to P3 are this camera's, R0_rect is the identity, the lidar frame is the bev frame."""
    projection = np.concatenate([camera.intrinsics, np.zeros((3, 1))], axis=1)
    rows = {f"P{number}": projection for number in range(4)}
    rows["R0_rect"] = np.eye(3)
    rows["Tr_velo_to_cam"] = (camera.camera_from_ego @ ego_from_bev)[:3]
    rows["Tr_imu_to_velo"] = inverse(ego_from_bev)[:3]
    return "".join(f"{name}: {' '.join(f'{number:.12e}' for number in row.ravel())}\n" for name, row in rows.items())


def open_kitti(path: Path, common: InputOptions, options: FolderOptions) -> FolderDrive:
    """A drive of KITTI as a `Drive`. Raises InputError."""
    drive = path.resolve()
    root = drive.parent.parent  # of KITTI-360
    tracking = root / "calib" / f"{drive.name}.txt"
    if drive.parent.name.startswith("image_0") and is_there(tracking):
        raise InputError(
            f"{path}: is of KITTI tracking, whose cameras have a folder each: copy its images into DRIVE/"
            f"{drive.parent.name}/data, and pass DRIVE, `calibration` (`--calibration {tracking}`), `image_rate_hz=10` "
            "(`--image-rate 10`) and `odometry=True` (`--odometry`)"
        )
    files = [folder / name for folder in (path, drive.parent, root / "calibration") for name in KITTI_FILES]
    if options.calibration is None and options.intrinsics is None and options.fov_deg is None:
        calibration = next((file for file in files if is_there(file)), None)
        if calibration is None:
            raise InputError(
                f"{path}: has no calibration (expected calib.txt, calib_cam_to_cam.txt in the folder above, or "
                f"{root.name}/calibration/perspective.txt): add it, or pass `calibration` (`--calibration FILE`)"
            )
        options = replace(options, calibration=calibration)
    if options.ego_motion_file is None:
        beside = (root / f"poses/{drive.name}.txt", root / f"data_poses/{drive.name}/poses.txt")
        poses = (path / "poses.txt", path / f"{drive.name}.txt", *beside, path / "oxts")
        options = replace(options, ego_motion_file=next((file for file in poses if is_there(file)), None))
    return FolderDrive(path, common, options)


def read_kitti(path: Path) -> Cameras | None:
    """The rectified cameras of KITTI: image_02 of calib_cam_to_cam.txt, image_2 of P2 in other files; None for others.

    The origin is on the road, below the rear axle. Poses need Tr_velo_to_cam, Tr, or calib_velo_to_cam.txt beside. In
    KITTI-360 they are in calib_cam_to_pose.txt beside, with the origin at its GPS and IMU.
    """
    file = next((path / name for name in KITTI_FILES if (path / name).exists()), path)
    if file.suffix != ".txt":
        return None
    rows = _kitti_rows(file)
    camera0_from_velodyne = _camera0_from_velodyne(rows, file)
    rectified_from_camera0 = _rectification(rows, ("R_rect_00", "R0_rect", "R_rect"), file)
    beside = file.with_name(CAMERAS_TO_POSE)
    on_body = _kitti_rows(beside) if file.name == KITTI_FILES[-1] and is_there(beside) else {}
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
        name, size = f"image_{'0' if match[1] else ''}{match[2]}", f"S_rect_0{match[2]}"
        if name in on_body:
            rectified_from_camera = _rectification(rows, (f"R_rect_0{match[2]}",), file)
            body_from_camera = _row(on_body, name, 12, beside).reshape(3, 4)
            matrix_on_body = rigid(body_from_camera[:, 3], body_from_camera[:, :3]) @ inverse(rectified_from_camera)
            pose = StatedPose({"": matrix_on_body}, "ego_from_camera", axes="optical", name=CAMERAS_TO_POSE)
        cameras[name] = StatedCamera(
            (matrix / matrix[2, 2]).tolist(),
            (rows[size][0], rows[size][-1]) if size in rows else None,
            {"model": "none"},
            pose,
        )
    if not cameras and file.name == CAMERAS_TO_POSE:
        raise InputError(
            f"{file}: has poses of cameras and no intrinsics: pass {KITTI_FILES[-1]}, with this file beside"
        )
    if not cameras:
        raise InputError(f"{file}: has no projection matrix (expected P2, or P_rect_02, of KITTI)")
    return cameras


def _rectification(rows: Mapping[str, Array], names: tuple[str, ...], file: Path) -> Array:
    """(4, 4) rectified_from_camera of the first of these rows; the identity without one."""
    row = next((_row(rows, name, 9, file) for name in names if name in rows), None)
    return rigid(rotation=None if row is None else row.reshape(3, 3))


def _camera0_from_velodyne(rows: Mapping[str, Array], file: Path) -> Array | None:
    """(4, 4), of the file or of that beside it; None if there is none."""
    name = next((key for key in ("Tr_velo_to_cam", "Tr", "Tr_velo_cam") if key in rows), None)
    if name is not None:
        matrix = _row(rows, name, 12, file).reshape(3, 4)
        return rigid(matrix[:, 3], matrix[:, :3])
    beside = file.parent / "calib_velo_to_cam.txt"
    return _rigid_of(beside) if beside.exists() else None


def _rigid_of(path: Path) -> Array:
    """(4, 4) of R and T in one of KITTI's files: calib_imu_to_velo.txt has velodyne_from_imu. Raises InputError."""
    rows = _kitti_rows(path)
    return rigid(_row(rows, "T", 3, path), _row(rows, "R", 9, path).reshape(3, 3))


def _kitti_rows(path: Path) -> dict[str, Array]:
    rows = {}
    for number, line in lines_of(path):
        key, _, text = line.partition(":") if ":" in line else line.partition(" ")  # tracking has no colons
        numbers = [number_of(word) for word in text.split()]
        if not numbers:
            raise InputError(f"{path}: line {number}: expected NAME: NUMBERS, as in KITTI")
        if None not in numbers:
            if key.strip() in rows:
                raise InputError(f"{path}: line {number}: {key.strip():.60} is in the file twice: keep one")
            rows[key.strip()] = np.array(numbers, dtype=np.float64)
    return rows


def _row(rows: Mapping[str, Array], key: str, count: int, path: Path) -> Array:
    row = rows.get(key)
    if row is None or row.size != count or not np.isfinite(row).all():
        raise InputError(f"{path}: {key}: expected {count} finite numbers, found {0 if row is None else row.size}")
    return row


def read_oxts(folder: Path) -> ReadPoses:
    """The poses of the vehicle from KITTI's folder of GPS and IMU, whose place is in calib_imu_to_velo.txt above it.

    The world has x east, y north and z up; its origin is the first place of the IMU. Raises InputError.
    """
    if not (folder / "data").is_dir():
        raise InputError(
            f"{folder}: is no folder of poses (expected data and timestamps.txt of KITTI's oxts): pass a file, such as "
            f"{AS_TEXT}"
        )
    files = sorted((folder / "data").glob("*.txt"))
    times = read_times(folder / "timestamps.txt")
    if not files or len(times) != len(files):
        raise InputError(
            f"{folder}: has {len(times)} times and {counted(len(files), 'files')} in data (expected as many)"
        )
    numbers = np.stack([_oxts_numbers(file) for file in files])
    origin = GeoOrigin(float(numbers[0, 0]), float(numbers[0, 1]), EAST_DEG)
    positions = np.column_stack([origin.points(numbers[:, :2]), numbers[:, 2] - numbers[0, 2]])
    quaternions = quaternions_of_angles(*numbers[:, 3:6].T)
    places = (up / "calib_imu_to_velo.txt" for up in (folder.resolve().parent, folder.resolve().parent.parent))
    place = next((file for file in places if is_there(file)), None)
    if place is not None:
        imu_from_ego = Pose.from_matrix(inverse(EGO_FROM_VELODYNE @ _rigid_of(place)))
        positions = positions + rotated(quaternions, imu_from_ego.translation)
        quaternions = product(quaternions, imu_from_ego.quaternion[None])
    of = "the vehicle" if place is not None else "the IMU (calib_imu_to_velo.txt is missing)"
    rate = f" at {1e9 / np.median(np.diff(times)):.1f} Hz" if len(times) > 1 else ""
    note = f"poses: KITTI's {folder.name}, {counted(len(files), 'rows')}{rate}, of {of}"
    kinematics = derive_kinematics(times, positions, quaternions)
    motion = EgoMotion(times, positions, quaternions, *kinematics, velocities_are_stated=False)
    return ReadPoses(motion, (note,), origin)


def _oxts_numbers(file: Path) -> Array:
    """The numbers of a file, of which the first six are used."""
    try:
        numbers = np.array(read_text(file, MIB).split(), dtype=np.float64)
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != OXTS_NUMBERS or not np.isfinite(numbers).all():
        raise InputError(f"{file}: expected {OXTS_NUMBERS} finite numbers, as KITTI's oxts has them")
    return numbers
