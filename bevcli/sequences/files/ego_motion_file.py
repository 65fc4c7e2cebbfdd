"""ego_motion.csv: strict CSV, with error messages that name line and column. Other files of poses are handed over."""

import io
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.geometry.transforms import Array, GeoOrigin
from bevcli.options import named
from bevcli.parsing.documents import LARGEST_INTEGER, CsvRow, csv_rows, parse_numbers_at_once
from bevcli.parsing.files import is_there, open_regular
from bevcli.sequences.files.readings import PoseReading
from bevcli.sequences.options import RigOptions

EGO_MOTION = "ego_motion.csv"
TRANSLATION = ("x", "y", "z")
QUATERNION = ("qw", "qx", "qy", "qz")
ACCELERATION = ("ax", "ay", "az")
ANGULAR_RATE = ("wx", "wy", "wz")
VELOCITY = ("vx", "vy", "vz")
NORM_TOLERANCE = 1e-3  # largest deviation of a quaternion's norm from 1


class FrameTimesNeeded(InputError):
    """A file of poses cannot be read without the times of the frames. Raised where they were not given."""


@dataclass(frozen=True)
class DrivePoses:
    """The drive that a file of poses is for, and what the user states of the file."""

    rig: CameraRig  # of the drive
    stated: RigOptions  # `pose_times`, `pose_angles` and `poses_of`, each None where it is to be found
    times_ns: NDArray[np.int64] | None = None  # (F,) of its frames; None while they are not known
    rig_is_open: bool = False  # the poses of its cameras are one of several readings
    numbers: NDArray[np.int64] | None = None  # (F,) of its frames, as times_ns


@dataclass(frozen=True)
class ReadPoses:
    """The poses of a file."""

    motion: EgoMotion | None  # None without poses
    notes: tuple[str, ...] = ()  # for the user, such as how the file was read
    geo_origin: GeoOrigin | None = None  # the place of their world frame on Earth, where the file says it
    # what the poses of another program may be, the motion being the first; empty where they are certain
    readings: tuple[PoseReading, ...] = ()
    others: tuple[PoseReading, ...] = ()  # readings that contradict what the user states
    file: Path = Path()  # of the poses


def read_poses(path: Path, drive: DrivePoses) -> ReadPoses:
    """The poses of ego_motion.csv, or of a file of another program, by the wing `formats`.

    Raises InputError, and FrameTimesNeeded for a file whose times only those of the frames can explain.
    """
    if _is_own(path):
        for name in ("pose_times", "pose_angles"):
            if getattr(drive.stated, name) is not None:
                raise InputError(f"{path}: states all of its poses: remove {named(RigOptions, name)}")
        own = read_ego_motion(path)
        if any(getattr(drive.stated, name) is not None for name in ("poses_of", "pose_axes", "pose_transform")):
            return _of_others(path, drive) or ReadPoses(own)
        return ReadPoses(own) if own.velocities_are_stated or path.name == EGO_MOTION else _doubted(own, path, drive)
    poses = _of_others(path, drive)
    if poses is not None:
        return poses
    try:
        return ReadPoses(read_ego_motion(path))
    except InputError as error:
        raise InputError(f"{error}; other kinds of poses are in docs/other-inputs.md#poses") from None


def _of_others(path: Path, drive: DrivePoses) -> ReadPoses | None:
    """Poses of another program; None for a file that is none of these."""
    from bevcli.workshop.formats.poses import read_poses as read_poses_of_others

    return read_poses_of_others(path, drive)


def _doubted(own: EgoMotion, path: Path, drive: DrivePoses) -> ReadPoses:
    """Poses with the columns of ego_motion.csv, which others write too: believed unless images clearly contradict."""
    try:
        others = _of_others(path, drive)
    except InputError:
        others = None
    states = {"pose_transform": "world_from_body", "pose_axes": "flu", "poses_of": "vehicle"}
    readings = [PoseReading(states, own.translations, own.quaternions)]
    readings += [replace(each, rank=each.rank + 1) for each in others.readings] if others else []
    return ReadPoses(own, readings=tuple(readings) if len(readings) > 1 else (), file=path)


def _is_own(path: Path) -> bool:
    """True for a file with the header of ego_motion.csv; and for one that is missing, which its reader says."""
    if not is_there(path):
        return True
    if path.is_dir():
        return False
    with open_regular(path) as file:
        head = file.readline(1000)
    names = [name.strip() for name in head.split(b",")]
    return b"timestamp_ns" in head and b"qw" in head and (b"x" in names or path.name == EGO_MOTION)


def read_ego_motion(path: Path) -> EgoMotion:
    """Read world_from_ego at T times. Missing kinematics are derived from the poses.

    Raises InputError for an invalid column or cell, times that do not increase, or a quaternion without norm 1.
    """
    required = ("timestamp_ns", *TRANSLATION, *QUATERNION)
    stated = ACCELERATION, ANGULAR_RATE, VELOCITY
    optional = sum(stated, ())
    first = next(csv_rows(path, required, optional))
    there = [names for names in stated if _are_there(names, first)]
    table = _numbers_at_once(path, tuple(first.cells))
    if table is None:
        table = _numbers_of_rows(csv_rows(path, required, optional), tuple(first.cells))
    times, quaternions, translations = (
        table["timestamp_ns"].copy(),
        *(_array(table, g) for g in (QUATERNION, TRANSLATION)),
    )
    found = {names: _array(table, names) for names in there}
    del table  # of a long drive, it takes as much memory as all that is derived from it
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)  # with the stored sign
    derived = derive_kinematics(times, translations, quaternions)
    kinematics = [found.get(names, own) for names, own in zip(stated, derived, strict=True)]
    return EgoMotion(times, translations, quaternions, *kinematics, velocities_are_stated=VELOCITY in found)


def _types(columns: tuple[str, ...]) -> np.dtype[Any]:
    return np.dtype([(name, "i8" if name == "timestamp_ns" else "f8") for name in columns])


def _array(table: NDArray[Any], names: tuple[str, ...]) -> Array:
    """(T, N) columns of a table."""
    return np.stack([table[name] for name in names], axis=1)


def _numbers_at_once(path: Path, columns: tuple[str, ...]) -> NDArray[Any] | None:
    """The table, parsed a hundred times as fast as row by row; None for one with a mistake, which a row then names."""
    with open_regular(path) as file:
        table = parse_numbers_at_once(io.TextIOWrapper(file, "utf-8"), _types(columns), ",", skipped=1)
    if table is None:
        return None
    times = table["timestamp_ns"]
    norms = np.linalg.norm(_array(table, QUATERNION), axis=1)
    is_sound = (np.diff(times) > 0).all() and (np.abs(norms - 1) <= NORM_TOLERANCE).all()
    return table if is_sound and abs(times[[0, -1]]).max() <= LARGEST_INTEGER else None


def _numbers_of_rows(rows: Iterable[CsvRow], columns: tuple[str, ...]) -> NDArray[Any]:
    """The table, row by row. Raises InputError with line and column of the first mistake."""
    lines, before = [], -LARGEST_INTEGER - 1
    for row in rows:
        cells = {name: row.integer(name) if name == "timestamp_ns" else row.number(name) for name in columns}
        if (time := int(cells["timestamp_ns"])) <= before:
            raise row.error("timestamp_ns", f"{time} is not later than the previous row ({before}): sort the rows")
        norm = float(np.linalg.norm([cells[name] for name in QUATERNION]))
        if abs(norm - 1) > NORM_TOLERANCE:
            message = f"the quaternion's norm is {norm:.6g} (expected 1): check its digits and their order"
            raise row.error("qw..qz", message)
        before = time
        lines.append(tuple(cells.values()))
    return np.array(lines, dtype=_types(columns))


def _are_there(names: tuple[str, ...], row: CsvRow) -> bool:
    """Whether a row has all of the columns. Raises InputError where it has some of them."""
    there = [name for name in names if name in row.cells]
    if there and len(there) < len(names):
        raise InputError(
            f"{row.path}: expected all of the columns {', '.join(names)} or none (found only {', '.join(there)}): "
            "add the others, or remove all to derive them from the poses"
        )
    return bool(there)
