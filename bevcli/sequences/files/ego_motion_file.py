"""ego_motion.csv: strict CSV, with error messages that name line and column."""

from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.geometry.transforms import Array
from bevcli.parsing.documents import read_csv

TRANSLATION = ("x", "y", "z")
QUATERNION = ("qw", "qx", "qy", "qz")
ACCELERATION = ("ax", "ay", "az")
ANGULAR_RATE = ("wx", "wy", "wz")
VELOCITY = ("vx", "vy", "vz")
NORM_TOLERANCE = 1e-3  # largest deviation of a quaternion's norm from 1


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
