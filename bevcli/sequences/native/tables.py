"""frames.csv and ego_motion.csv: strict CSV, with error messages that name line and column."""

import csv
import re
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.geometry.transforms import Array
from bevcli.parsing.documents import CsvRow, read_csv
from bevcli.sequences.images import FrameEntry, ImageSource
from bevcli.writing import whole_file

VIDEO_CELL = re.compile(r"(?P<path>.+)#(?P<index>[0-9]{1,9})")
NO_IMAGE = "no image in frames.csv"
TRANSLATION = ("x", "y", "z")
QUATERNION = ("qw", "qx", "qy", "qz")
ACCELERATION = ("ax", "ay", "az")
ANGULAR_RATE = ("wx", "wy", "wz")
VELOCITY = ("vx", "vy", "vz")
NORM_TOLERANCE = 1e-3  # largest deviation of a quaternion's norm from 1


def read_frames_table(path: Path, cameras: Sequence[str]) -> tuple[FrameEntry, ...]:
    """Read frames.csv. A camera's cell is a path relative to the table's folder, or `video#index`.

    Raises InputError for an invalid column or cell, a camera without a column, or times that do not increase in a
    scene.
    """
    times = [f"{name}.timestamp_ns" for name in cameras]
    rows = read_csv(path, ("frame", "timestamp_ns"), ("scene", *cameras, *times))
    for name in cameras:
        if name not in rows[0].cells:
            raise InputError(
                f"{path}: camera {name}: its column is missing (expected, because the calibration has the camera): "
                f'add a column "{name}" (cells may be empty), or remove the camera from the calibration'
            )
    entries = tuple(_entry(row, cameras, path.parent) for row in rows)
    _check_numbers(rows, entries)
    check_times(entries)
    return entries


def check_times(entries: Iterable[FrameEntry]) -> None:
    """Raise InputError unless times increase within each scene, a run of frames with the same scene name."""
    for earlier, entry in pairwise(entries):
        before, stamp = earlier.stamp, entry.stamp
        if before.scene == stamp.scene and stamp.timestamp_ns <= before.timestamp_ns:
            raise InputError(
                f"{entry.origin}: timestamp_ns {stamp.timestamp_ns} is not later than the previous frame's "
                f"({before.timestamp_ns}): sort the frames by time, or give them different scenes"
            )


def _entry(row: CsvRow, cameras: Sequence[str], folder: Path) -> FrameEntry:
    stamp = FrameStamp(row.integer("frame"), row.cells.get("scene", ""), row.integer("timestamp_ns"))
    sources = {name: _source(row, name, folder, stamp.timestamp_ns) for name in cameras if row.cells[name]}
    dropped = {name: NO_IMAGE for name in cameras if not row.cells[name]}
    return FrameEntry(stamp, sources, dropped, f"{row.path}: line {row.line}")


def _source(row: CsvRow, camera: str, folder: Path, frame_ns: int) -> ImageSource:
    time_column = f"{camera}.timestamp_ns"
    timestamp_ns = row.integer(time_column) if row.cells.get(time_column) else frame_ns
    video = VIDEO_CELL.fullmatch(row.cells[camera])
    if video:
        return ImageSource(folder / video["path"], timestamp_ns, int(video["index"]))
    return ImageSource(folder / row.cells[camera], timestamp_ns)


def _check_numbers(rows: Sequence[CsvRow], entries: Sequence[FrameEntry]) -> None:
    seen: dict[int, int] = {}
    for row, entry in zip(rows, entries, strict=True):
        number = entry.stamp.index
        if number < 0 or number in seen:
            found = f"is also on line {seen[number]}" if number in seen else "is negative"
            raise row.error("frame", f"{number} {found} (expected a unique integer, 0 or more)")
        seen[number] = row.line


def read_ego_motion(path: Path) -> EgoMotion:
    """Read world_from_ego at T times. Missing kinematics are derived from the poses.

    Raises InputError for an invalid column or cell, times that do not increase, or a quaternion without norm 1.
    """
    required = ("timestamp_ns", *TRANSLATION, *QUATERNION)
    rows = read_csv(path, required, (*ACCELERATION, *ANGULAR_RATE, *VELOCITY))
    times = _times(rows)
    translations = _columns(rows, TRANSLATION)
    quaternions = np.stack([_quaternion(row) for row in rows])
    derived = derive_kinematics(times, translations, quaternions)
    stated = [_group(rows, names) for names in (ACCELERATION, ANGULAR_RATE, VELOCITY)]
    kinematics = [from_poses if own is None else own for own, from_poses in zip(stated, derived, strict=True)]
    return EgoMotion(times, translations, quaternions, *kinematics, velocities_are_stated=stated[2] is not None)


def write_ego_motion(path: Path, motion: EgoMotion) -> None:
    """Write all columns, so that `read_ego_motion` returns the same numbers. Raises OutputError."""
    columns = (motion.translations, motion.quaternions, motion.accelerations, motion.angular_rates, motion.velocities)
    numbers = np.concatenate(columns, axis=1)  # (T, 16)
    with whole_file(path) as unfinished, unfinished.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["timestamp_ns", *TRANSLATION, *QUATERNION, *ACCELERATION, *ANGULAR_RATE, *VELOCITY])
        for time, row in zip(motion.timestamps_ns, numbers, strict=True):
            writer.writerow([int(time), *(repr(float(value)) for value in row)])


def _times(rows: Sequence[CsvRow]) -> NDArray[np.int64]:
    times = [row.integer("timestamp_ns") for row in rows]
    for row, (earlier, time) in zip(rows[1:], pairwise(times), strict=True):
        if time <= earlier:
            raise row.error("timestamp_ns", f"{time} is not later than the previous row ({earlier}): sort the rows")
    return np.array(times, dtype=np.int64)


def _columns(rows: Sequence[CsvRow], names: tuple[str, ...]) -> Array:
    return np.array([[row.number(name) for name in names] for row in rows])


def _group(rows: Sequence[CsvRow], names: tuple[str, ...]) -> Array | None:
    """(T, 3) of three columns, None if the table has none of them. Raises InputError if it has only some."""
    there = [name for name in names if name in rows[0].cells]
    if there and len(there) < len(names):
        raise InputError(
            f"{rows[0].path}: expected all of the columns {', '.join(names)} or none (found only {', '.join(there)}): "
            "add the others, or remove all to derive them from the poses"
        )
    return _columns(rows, names) if there else None


def _quaternion(row: CsvRow) -> Array:
    """(4,) w, x, y, z with the stored sign, normalised to a norm of exactly 1."""
    quaternion = np.array([row.number(name) for name in QUATERNION])
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > NORM_TOLERANCE:
        raise row.error("qw..qz", f"the quaternion's norm is {norm:.6g} (expected 1): check its digits and their order")
    return quaternion / norm
