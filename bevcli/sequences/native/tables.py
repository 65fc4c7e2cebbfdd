"""frames.csv and ego_motion.csv: strict CSV, with error messages that name line and column."""

import csv
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.geometry.transforms import Array
from bevcli.parsing.csv_cells import name_of
from bevcli.parsing.documents import LARGEST_INTEGER
from bevcli.parsing.files import read_text
from bevcli.sequences.images import FrameEntry, ImageSource
from bevcli.writing import whole_file

LARGEST_BYTES = 256 << 20
LARGEST_NUMBER = 1e12  # in SI units, far beyond any position or motion of a vehicle
VIDEO_CELL = re.compile(r"(?P<path>.+)#(?P<index>[0-9]{1,9})")
NO_IMAGE = "no image in frames.csv"
TRANSLATION = ("x", "y", "z")
QUATERNION = ("qw", "qx", "qy", "qz")
ACCELERATION = ("ax", "ay", "az")
ANGULAR_RATE = ("wx", "wy", "wz")
VELOCITY = ("vx", "vy", "vz")
NORM_TOLERANCE = 1e-3  # largest deviation of a quaternion's norm from 1


@dataclass(frozen=True)
class CsvRow:
    """One row of a CSV file. line: in the file, from 1. cells: text by column, without surrounding spaces."""

    path: Path
    line: int
    cells: dict[str, str]

    def error(self, column: str, what: str) -> InputError:
        """The error to raise for a mistake in this row."""
        return InputError(f"{self.path}: line {self.line}, column {column}: {what}")

    def integer(self, column: str) -> int:
        """The cell as an integer of any size. Raises InputError if it is not one."""
        text = self.cells[column]
        digits = text.removeprefix("-")
        if not (digits.isascii() and digits.isdigit()):
            raise self.error(column, f'expected an integer, found "{text:.40}": remove decimal point and exponent')
        if len(digits) > 19 or int(digits) > LARGEST_INTEGER:
            raise self.error(column, f'the integer "{text:.24}" is too large (expected at most 62 bits)')
        return int(text)

    def number(self, column: str) -> float:
        """The cell as a finite number. Raises InputError if it is not one."""
        text = self.cells[column]
        try:
            value = float(text if text.isascii() and "_" not in text else "")  # Python also takes 1_000 and ١
        except ValueError:
            raise self.error(column, f'expected a number, found "{text:.40}"') from None
        if not abs(value) < LARGEST_NUMBER:
            raise self.error(column, f'expected a finite number, found "{text:.24}": correct or remove the row')
        return value


@dataclass(frozen=True)
class CsvTable:
    """A file's header and its rows in order."""

    path: Path
    columns: tuple[str, ...]
    rows: tuple[CsvRow, ...]


def read_csv(path: Path, required: Iterable[str], optional: Iterable[str] = ()) -> CsvTable:
    """Read a CSV file with a header (UTF-8, separated by commas).

    Raises InputError if the file cannot be read, a required column is missing, a column is unknown or repeated, a row
    has another number of cells than the header, or there are no rows.
    """
    required = tuple(required)
    lines = _lines(path)
    if not lines:
        raise InputError(f"{path}: the file is empty (expected a header with {', '.join(required)})")
    columns = tuple(name_of(cell.strip()) for cell in lines[0][1])
    _check_columns(path, columns, required, tuple(optional))
    for line, cells in lines:
        if any("\0" in cell for cell in cells):
            raise InputError(f"{path}: line {line}: has a null byte (expected text; the file may be damaged)")
    rows = tuple(_row(path, columns, line, cells) for line, cells in lines[1:])
    if not rows:
        raise InputError(f"{path}: the table has no rows below the header (expected at least one)")
    return CsvTable(path, columns, rows)


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """Line number and cells of every line that is not blank."""
    text = read_text(path, LARGEST_BYTES).removeprefix("\ufeff")
    try:
        reader = csv.reader(io.StringIO(text, newline=""))
        return [(reader.line_num, cells) for cells in reader if cells]
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read as CSV ({error})") from None


def _check_columns(path: Path, columns: tuple[str, ...], required: tuple[str, ...], optional: tuple[str, ...]) -> None:
    missing = [name for name in required if name not in columns]
    if missing and len(columns) == 1:
        for character, name in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars")):
            if character in columns[0]:
                raise InputError(f"{path}: the columns are separated by {name} (expected commas): save it with commas")
    if missing:
        raise InputError(f'{path}: column "{missing[0]}" is missing (found: {", ".join(columns)})')
    known = {*required, *optional}
    unknown = [name for name in columns if name not in known]
    if unknown:
        raise InputError(f'{path}: unknown column "{unknown[0]}" (known: {", ".join((*required, *optional))})')
    twice = [name for name in columns if columns.count(name) > 1]
    if twice:
        raise InputError(f'{path}: column "{twice[0]}" appears twice in the header')


def _row(path: Path, columns: tuple[str, ...], line: int, cells: list[str]) -> CsvRow:
    if len(cells) != len(columns):
        raise InputError(f"{path}: line {line} has {len(cells)} cells (expected {len(columns)}, as in the header)")
    return CsvRow(path, line, {name: name_of(cell.strip()) for name, cell in zip(columns, cells, strict=True)})


def read_frames_table(path: Path, cameras: Sequence[str]) -> tuple[FrameEntry, ...]:
    """Read frames.csv. A camera's cell is a path relative to the table's folder, or `video#index`.

    Raises InputError for an invalid column or cell, a camera without a column, or times that do not increase in a
    scene.
    """
    table = _read_columns(path, cameras)
    entries = tuple(_entry(row, cameras, path.parent) for row in table.rows)
    _check_numbers(table.rows, entries)
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


def _read_columns(path: Path, cameras: Sequence[str]) -> CsvTable:
    times = [f"{name}.timestamp_ns" for name in cameras]
    table = read_csv(path, ("frame", "timestamp_ns"), ("scene", *cameras, *times))
    for name in cameras:
        if name not in table.columns:
            raise InputError(
                f"{path}: camera {name}: its column is missing (expected, because the calibration has the camera): "
                f'add a column "{name}" (cells may be empty), or remove the camera from the calibration'
            )
    return table


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
    table = read_csv(path, required, (*ACCELERATION, *ANGULAR_RATE, *VELOCITY))
    times = _times(table)
    translations = _columns(table, TRANSLATION)
    quaternions = np.stack([_quaternion(row) for row in table.rows])
    derived = derive_kinematics(times, translations, quaternions)
    stated = [_group(table, names) for names in (ACCELERATION, ANGULAR_RATE, VELOCITY)]
    kinematics = [from_poses if own is None else own for own, from_poses in zip(stated, derived, strict=True)]
    return EgoMotion(times, translations, quaternions, *kinematics, velocities_are_stated=stated[2] is not None)


def write_ego_motion(path: Path, ego_motion: EgoMotion) -> None:
    """Write all columns, so that `read_ego_motion` returns the same numbers. Raises OutputError."""
    columns = (
        ego_motion.translations,
        ego_motion.quaternions,
        ego_motion.accelerations,
        ego_motion.angular_rates,
        ego_motion.velocities,
    )
    numbers = np.concatenate(columns, axis=1)  # (T, 16)
    with whole_file(path) as unfinished, unfinished.open("w", newline="", encoding="utf-8") as file:
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
