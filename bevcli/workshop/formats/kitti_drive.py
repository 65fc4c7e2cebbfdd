"""KITTI as it lies on disk, odometry (`sequences/00`) and raw (`2011_09_26/2011_09_26_drive_0001_sync`).

Calibration, times and poses are found where the data set has them; options replace them. The folder `oxts` has the
poses of the vehicle from GPS and IMU, a file for each time.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.geometry.transforms import EAST_DEG, Array, GeoOrigin, Pose, inverse, rigid
from bevcli.parsing.files import MIB, is_there, read_text
from bevcli.printing import counted
from bevcli.sequences.files.ego_motion_file import ReadPoses
from bevcli.sequences.native import FolderOptions
from bevcli.sequences.native.folder import FolderDrive
from bevcli.sequences.options import InputOptions
from bevcli.workshop.formats.camera_poses import Cameras, StatedCamera, StatedPose
from bevcli.workshop.formats.name_times import read_times
from bevcli.workshop.formats.other_calibrations import lines_of
from bevcli.workshop.formats.pose_readings import product, quaternions_of_angles, rotated
from bevcli.workshop.formats.pose_table import number_of

KITTI_FILES = ("calib_cam_to_cam.txt", "calib.txt")
# The Velodyne is 0.76 m ahead of the rear axle and 1.73 m above the road (the data set's drawing of the vehicle).
EGO_FROM_VELODYNE = rigid((0.76, 0.0, 1.73))
OXTS_NUMBERS = 30  # of a file: latitude, longitude, altitude, roll, pitch, yaw and so on


def open_kitti(path: Path, common: InputOptions, options: FolderOptions) -> FolderDrive:
    """A drive of KITTI as a `Drive`. Raises InputError."""
    files = [folder / name for folder in (path, path.resolve().parent) for name in KITTI_FILES]
    if options.calibration is None and options.intrinsics is None and options.fov_deg is None:
        calibration = next((file for file in files if is_there(file)), None)
        if calibration is None:
            raise InputError(
                f"{path}: has no calibration (expected calib.txt, or calib_cam_to_cam.txt in the folder above): add "
                "it, or pass `calibration` (`--calibration FILE`)"
            )
        options = replace(options, calibration=calibration)
    if options.ego_motion_file is None:
        drive = path.resolve()
        beside = drive.parent.parent / f"poses/{drive.name}.txt"
        poses = (path / "poses.txt", path / f"{drive.name}.txt", beside, path / "oxts")
        options = replace(options, ego_motion_file=next((file for file in poses if is_there(file)), None))
    return FolderDrive(path, common, options)


def read_kitti(path: Path) -> Cameras | None:
    """The rectified cameras of KITTI: image_02 of calib_cam_to_cam.txt, image_2 of P2 in other files; None for others.

    The origin is on the road, below the rear axle. Poses need Tr_velo_to_cam, Tr, or calib_velo_to_cam.txt beside.
    """
    file = next((path / name for name in KITTI_FILES if (path / name).exists()), path)
    if file.suffix != ".txt":
        return None
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
    return _rigid_of(beside)


def _rigid_of(path: Path) -> Array:
    """(4, 4) of R and T in one of KITTI's files: calib_imu_to_velo.txt has velodyne_from_imu. Raises InputError."""
    rows = _kitti_rows(path)
    return rigid(_row(rows, "T", 3, path), _row(rows, "R", 9, path).reshape(3, 3))


def _kitti_rows(path: Path) -> dict[str, Array]:
    rows = {}
    for number, line in lines_of(path):
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


def read_oxts(folder: Path) -> ReadPoses:
    """The poses of the vehicle from KITTI's folder of GPS and IMU, whose place is in calib_imu_to_velo.txt above it.

    The world has x east, y north and z up; its origin is the first place of the IMU. Raises InputError.
    """
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
