"""KITTI's folder `oxts`: poses of the vehicle from GPS and IMU, a file for each time."""

from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.geometry.transforms import EAST_DEG, Array, GeoOrigin, Pose, inverse
from bevcli.parsing.files import MIB, is_there, read_text
from bevcli.printing import counted
from bevcli.sequences.files.ego_motion_file import ReadPoses
from bevcli.workshop.formats.listed_times import read_times
from bevcli.workshop.formats.other_calibrations import EGO_FROM_VELODYNE, kitti_transform
from bevcli.workshop.formats.pose_readings import product, quaternions_of_angles, rotated

NUMBERS = 30  # of a file: latitude, longitude, altitude, roll, pitch, yaw and so on


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
    numbers = np.stack([_numbers(file) for file in files])
    origin = GeoOrigin(float(numbers[0, 0]), float(numbers[0, 1]), EAST_DEG)
    positions = np.column_stack([origin.points(numbers[:, :2]), numbers[:, 2] - numbers[0, 2]])
    quaternions = quaternions_of_angles(*numbers[:, 3:6].T)
    places = (up / "calib_imu_to_velo.txt" for up in (folder.resolve().parent, folder.resolve().parent.parent))
    place = next((file for file in places if is_there(file)), None)
    if place is not None:
        imu_from_ego = Pose.from_matrix(inverse(EGO_FROM_VELODYNE @ kitti_transform(place)))
        positions = positions + rotated(quaternions, imu_from_ego.translation)
        quaternions = product(quaternions, imu_from_ego.quaternion[None])
    of = "the vehicle" if place is not None else "the IMU (calib_imu_to_velo.txt is missing)"
    rate = f" at {1e9 / np.median(np.diff(times)):.1f} Hz" if len(times) > 1 else ""
    note = f"poses: KITTI's {folder.name}, {counted(len(files), 'rows')}{rate}, of {of}"
    kinematics = derive_kinematics(times, positions, quaternions)
    motion = EgoMotion(times, positions, quaternions, *kinematics, velocities_are_stated=False)
    return ReadPoses(motion, (note,), origin)


def _numbers(file: Path) -> Array:
    """The numbers of a file, of which the first six are used."""
    try:
        numbers = np.array(read_text(file, MIB).split(), dtype=np.float64)
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != NUMBERS or not np.isfinite(numbers).all():
        raise InputError(f"{file}: expected {NUMBERS} finite numbers, as KITTI's oxts has them")
    return numbers
