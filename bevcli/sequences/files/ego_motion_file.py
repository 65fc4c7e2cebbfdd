"""ego_motion.csv: strict CSV, with error messages that name line and column. Other files of poses are handed over."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.geometry.transforms import Array, GeoOrigin
from bevcli.parsing.documents import read_csv
from bevcli.parsing.files import is_there, open_regular
from bevcli.sequences.files.readings import PoseReading
from bevcli.sequences.options import RigOptions

TRANSLATION = ("x", "y", "z")
QUATERNION = ("qw", "qx", "qy", "qz")
ACCELERATION = ("ax", "ay", "az")
ANGULAR_RATE = ("wx", "wy", "wz")
VELOCITY = ("vx", "vy", "vz")
NORM_TOLERANCE = 1e-3  # largest deviation of a quaternion's norm from 1
AHEAD = np.radians(45)  # largest yaw of a camera that looks ahead


class FrameTimesNeeded(InputError):
    """A file of poses cannot be read without the times of the frames. Raised where they were not given."""


@dataclass(frozen=True)
class DrivePoses:
    """The drive that a file of poses is for, and what the user states of the file.

    Attributes:
        rig: of the drive.
        stated: `pose_times`, `pose_angles` and `poses_of`, each None where it is to be found.
        times_ns: (F,) of its frames; None while they are not known.
        rig_is_open: the poses of its cameras are one of several readings.
    """

    rig: CameraRig
    stated: RigOptions
    times_ns: NDArray[np.int64] | None = None
    rig_is_open: bool = False

    @property
    def cameras_ahead(self) -> list[Camera]:
        """The cameras that look ahead."""
        return [camera for camera in self.rig.cameras if abs(camera.yaw) <= AHEAD]


@dataclass(frozen=True)
class ReadPoses:
    """The poses of a file.

    Attributes:
        motion: None without poses.
        notes: for the user, such as how the file was read.
        geo_origin: the place of their world frame on Earth, where the file says it.
        readings: what the poses of another program may be, the motion being the first; empty where they are certain.
        file: of the poses.
    """

    motion: EgoMotion | None
    notes: tuple[str, ...] = ()
    geo_origin: GeoOrigin | None = None
    readings: tuple[PoseReading, ...] = ()
    file: Path = Path()


def read_poses(path: Path, drive: DrivePoses) -> ReadPoses:
    """The poses of ego_motion.csv, or of a file of another program, by the wing `formats`.

    Raises InputError, and FrameTimesNeeded for a file whose times only those of the frames can explain.
    """
    if _is_own(path):
        return ReadPoses(read_ego_motion(path))
    from bevcli.workshop.formats.poses import read_poses as read_poses_of_others

    poses = read_poses_of_others(path, drive)
    if poses is not None:
        return poses
    try:
        return ReadPoses(read_ego_motion(path))
    except InputError as error:
        raise InputError(f"{error}; other kinds of poses are in docs/other-inputs.md#poses") from None


def _is_own(path: Path) -> bool:
    """True for a file with the header of ego_motion.csv; and for one that is missing, which its reader says."""
    if not is_there(path):
        return True
    if path.is_dir():
        return False
    with open_regular(path) as file:
        head = file.readline(1000)
    return b"timestamp_ns" in head and b"qw" in head


def read_ego_motion(path: Path) -> EgoMotion:
    """Read world_from_ego at T times. Missing kinematics are derived from the poses.

    Raises InputError for an invalid column or cell, times that do not increase, or a quaternion without norm 1.
    """
    required = ("timestamp_ns", *TRANSLATION, *QUATERNION)
    rows = read_csv(path, required, (*ACCELERATION, *ANGULAR_RATE, *VELOCITY))
    stamps: list[int] = []
    normed: list[Array] = []  # with the stored sign
    for row in rows:
        time, quaternion = row.integer("timestamp_ns"), np.array([row.number(name) for name in QUATERNION])
        if stamps and time <= stamps[-1]:
            raise row.error("timestamp_ns", f"{time} is not later than the previous row ({stamps[-1]}): sort the rows")
        norm = float(np.linalg.norm(quaternion))
        if abs(norm - 1) > NORM_TOLERANCE:
            message = f"the quaternion's norm is {norm:.6g} (expected 1): check its digits and their order"
            raise row.error("qw..qz", message)
        stamps.append(time)
        normed.append(quaternion / norm)
    translations = np.array([[row.number(name) for name in TRANSLATION] for row in rows])
    times, quaternions = np.array(stamps, dtype=np.int64), np.stack(normed)
    kinematics = list(derive_kinematics(times, translations, quaternions))
    for index, names in enumerate((ACCELERATION, ANGULAR_RATE, VELOCITY)):
        there = [name for name in names if name in rows[0].cells]
        if there and len(there) < len(names):
            raise InputError(
                f"{path}: expected all of the columns {', '.join(names)} or none (found only {', '.join(there)}): "
                "add the others, or remove all to derive them from the poses"
            )
        if there:
            kinematics[index] = np.array([[row.number(name) for name in names] for row in rows])
    is_stated = VELOCITY[0] in rows[0].cells
    return EgoMotion(times, translations, quaternions, *kinematics, velocities_are_stated=is_stated)
