"""ego_motion.csv: rows of world_from_ego, optionally with acceleration, angular rate and velocity."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.geometry.transforms import Array
from bevcli.sequences.native.csv_table import CsvRow, CsvTable, read_csv

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
    table = read_csv(path, required, (*ACCELERATION, *ANGULAR_RATE, *VELOCITY))
    times = _times(table)
    translations = _columns(table, TRANSLATION)
    quaternions = np.stack([_quaternion(row) for row in table.rows])
    derived = derive_kinematics(times, translations, quaternions)
    stated = [_group(table, names) for names in (ACCELERATION, ANGULAR_RATE, VELOCITY)]
    kinematics = [from_poses if own is None else own for own, from_poses in zip(stated, derived, strict=True)]
    return EgoMotion(times, translations, quaternions, *kinematics, velocities_are_stated=stated[2] is not None)


def write_ego_motion(path: Path, ego_motion: EgoMotion) -> None:
    """Write all columns, so that `read_ego_motion` returns the same numbers."""
    columns = (
        ego_motion.translations,
        ego_motion.quaternions,
        ego_motion.accelerations,
        ego_motion.angular_rates,
        ego_motion.velocities,
    )
    numbers = np.concatenate(columns, axis=1)  # (T, 16)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["timestamp_ns", *TRANSLATION, *QUATERNION, *ACCELERATION, *ANGULAR_RATE, *VELOCITY])
        for time, row in zip(ego_motion.timestamps_ns, numbers, strict=True):
            writer.writerow([int(time), *(repr(float(value)) for value in row)])


def _times(table: CsvTable) -> NDArray[np.int64]:
    times = [row.integer("timestamp_ns") for row in table.rows]
    for row, earlier, time in zip(table.rows[1:], times, times[1:], strict=False):
        if time <= earlier:
            raise row.error("timestamp_ns", f"{time} is not later than the previous row ({earlier}): sort the rows")
    return np.array(times, dtype=np.int64)


def _columns(table: CsvTable, names: tuple[str, ...]) -> Array:
    return np.array([[row.number(name) for name in names] for row in table.rows])


def _group(table: CsvTable, names: tuple[str, ...]) -> Array | None:
    """(T, 3) of three columns, None if the table has none of them. Raises InputError if it has only some."""
    there = [name for name in names if name in table.columns]
    if there and len(there) < len(names):
        raise InputError(
            f"{table.path}: expected all of the columns {', '.join(names)} or none (found only {', '.join(there)}): "
            "add the others, or remove all to derive them from the poses"
        )
    return _columns(table, names) if there else None


def _quaternion(row: CsvRow) -> Array:
    """(4,) w, x, y, z with the stored sign, normalised to a norm of exactly 1."""
    quaternion = np.array([row.number(name) for name in QUATERNION])
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > NORM_TOLERANCE:
        raise row.error("qw..qz", f"the quaternion's norm is {norm:.6g} (expected 1): check its digits and their order")
    return quaternion / norm
