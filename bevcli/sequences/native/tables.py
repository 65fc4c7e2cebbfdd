"""frames.csv and ego_motion.csv: strict CSV, with error messages that name line and column."""

import csv
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

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
    lines: dict[int, int] = {}  # of frames, by index
    entries = []
    for row in rows:
        stamp = FrameStamp(row.integer("frame"), row.cells.get("scene", ""), row.integer("timestamp_ns"))
        if stamp.index < 0 or stamp.index in lines:
            found = f"is also on line {lines[stamp.index]}" if stamp.index in lines else "is negative"
            raise row.error("frame", f"{stamp.index} {found} (expected a unique integer, 0 or more)")
        lines[stamp.index] = row.line
        sources = {name: _source(row, name, stamp.timestamp_ns) for name in cameras if row.cells[name]}
        dropped = {name: NO_IMAGE for name in cameras if not row.cells[name]}
        entries.append(FrameEntry(stamp, sources, dropped, f"{path}: line {row.line}"))
    for earlier, entry in pairwise(entries):
        before, stamp = earlier.stamp, entry.stamp
        if before.scene == stamp.scene and stamp.timestamp_ns <= before.timestamp_ns:
            raise InputError(
                f"{entry.origin}: timestamp_ns {stamp.timestamp_ns} is not later than the previous frame's "
                f"({before.timestamp_ns}): sort the frames by time, or give them different scenes"
            )
    return tuple(entries)


def _source(row: CsvRow, camera: str, frame_ns: int) -> ImageSource:
    time_column = f"{camera}.timestamp_ns"
    timestamp_ns = row.integer(time_column) if row.cells.get(time_column) else frame_ns
    video = VIDEO_CELL.fullmatch(row.cells[camera])
    if video:
        return ImageSource(row.path.parent / video["path"], timestamp_ns, int(video["index"]))
    return ImageSource(row.path.parent / row.cells[camera], timestamp_ns)


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
    times, translations, quaternions = np.array(stamps, dtype=np.int64), _columns(rows, TRANSLATION), np.stack(normed)
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
