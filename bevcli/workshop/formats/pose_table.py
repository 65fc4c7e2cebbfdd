"""Tables of poses: the names of their columns, and their cells."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array
from bevcli.parsing.documents import CsvRow
from bevcli.workshop.formats.pose_texts import table_text

VECTOR, QUATERNION = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
MATRIX = tuple(f"m{row}{column}" for row in range(3) for column in range(4))  # world_from_camera, row by row
TUM = ("time", *VECTOR, "qx", "qy", "qz", "qw")
_UNIT = "(?:_(?:m|mm|cm|km|s|sec|seconds|ms|us|ns|deg|degrees|rad|radians))?"
_LENGTH = "(?:_(?:m|mm|cm|km))?"
_OF = "(?:.*[._])?"  # such as field.pose.pose. in front of position.x
# By quantity, the names of its column in lower case.
NAMES = {
    "time": rf"t|secs?|seconds|(?:gps|unix|utc|date)[_ ]?time{_UNIT}|"
            rf"{_OF}(?:time|times|timestamp|timestamps|stamp|utime|epoch){_UNIT}",
    "seconds": rf"{_OF}secs?",
    "nanoseconds": rf"{_OF}(?:nsecs?|nanosecs?)",
    **{axis: rf"[pt]?_?{axis}{_LENGTH}|p_\w+_{axis}|{_OF}(?:pos|pose|position|translation|location)[._]?{axis}{_LENGTH}"
       f"|(?:pos_|ned_|enu_)?{other}(?:ing)?{_LENGTH}|(?:pos|ned|enu)_{other[0]}{_LENGTH}"
       for axis, other in zip(VECTOR, ("east", "north", "up"), strict=True)},
    "down": rf"(?:pos_|ned_)?down{_LENGTH}|(?:pos|ned)_d{_LENGTH}",
    **{f"q{axis}": rf"q_?{axis}|q_\w+_{axis}|{_OF}(?:quat|quaternion|orientation|rotation|rot)[._]?{axis}"
       for axis in "wxyz"},
    "latitude": rf"{_OF}lat(?:itude)?{_UNIT}",
    "longitude": rf"{_OF}(?:lon|lng|long|longitude){_UNIT}",
    "altitude": rf"{_OF}(?:alt|altitude|elevation|ele|height){_UNIT}",
    "roll": rf"{_OF}roll{_UNIT}",
    "pitch": rf"{_OF}pitch{_UNIT}",
    "yaw": rf"{_OF}yaw{_UNIT}",
    "fix": rf"{_OF}(?:gps_?)?fix(?:_?(?:type|quality|mode))?",
    "status": rf"{_OF}(?:status\.status|status|nav_status)",
    "heading": rf"{_OF}(?:heading|course|azimuth|bearing){_UNIT}",
}  # fmt: skip


@dataclass(frozen=True)
class Table:
    """The cells of a file of poses.

    Attributes:
        path: the file.
        columns: quantity -> name of its column in the file, "" where the file has no names; in the order of the file.
        rows: cells by quantity.
        separator: of the columns; None for spaces.
        notes: how its numbers were understood.
    """

    path: Path
    columns: dict[str, str]
    rows: list[CsvRow]
    separator: str | None
    notes: tuple[str, ...] = ()

    def has(self, *names: str) -> bool:
        """True where it has all of these quantities."""
        return all(name in self.columns for name in names)

    def numbers(self, *names: str) -> Array:
        """(T, N) quantities; 0 where the table lacks one. Raises InputError that names line and column."""
        there = [name in self.columns for name in names]
        return np.array(
            [[row.number(name) if has else 0.0 for name, has in zip(names, there, strict=True)] for row in self.rows]
        )


def read_table(path: Path) -> Table | None:
    """The cells of a text file with columns; None where it has no rows, or not two columns that are known.

    Names of columns stand in the line above the rows, which may be a comment. Raises InputError for a row with another
    number of cells.
    """
    header, rows = "", list[tuple[int, str]]()
    for number, line in enumerate(table_text(path).splitlines(), 1):
        text = line.strip()
        if text.startswith(("#", "%")) or (not rows and re.match("[\"'A-Za-z_]", text)):
            header = header if rows else text.lstrip("#% ").lower()
        elif text:
            rows.append((number, text))
    if not rows:
        return None
    separator = next((sign for sign in (";", "\t", ",") if sign in rows[0][1]), None)
    count = len(_cells(rows[0][1], separator))
    names = _cells(header, separator)
    names = names if len(names) == count else re.split(r"[,;\s]+", header)
    places = _columns(path, names) if len(names) == count else {}
    if len(places) < 2:
        unnamed = {12: MATRIX, 8: TUM}.get(count, ())
        if separator == "," and count in (8, 17):  # EuRoC's own order
            unnamed = ("time", *VECTOR, *QUATERNION)
        places, names = {quantity: index for index, quantity in enumerate(unnamed)}, [""] * count
    if not places:
        return None
    table = Table(path, {quantity: names[index] for quantity, index in places.items()}, [], separator)
    for number, text in rows:
        cells = _cells(text.replace(",", ".") if separator in (";", "\t") else text, separator)
        if len(cells) != count:
            raise InputError(f"{path}: line {number} has {len(cells)} cells (expected {count}, as in the first row)")
        table.rows.append(CsvRow(path, number, {quantity: cells[index] for quantity, index in places.items()}))
    return table


def _cells(text: str, separator: str | None) -> list[str]:
    cells = [cell.strip().strip("\"'") for cell in text.split(separator)]
    return cells[:-1] if cells and not cells[-1] else cells


def _columns(path: Path, names: Sequence[str]) -> dict[str, int]:
    """The place of each known quantity. Raises InputError where two columns have the same."""
    places: dict[str, int] = {}
    for index, name in enumerate(names):
        plain = re.sub(r"\s*[\[(].*", "", name)  # without the unit
        quantity = next((quantity for quantity, pattern in NAMES.items() if re.fullmatch(pattern, plain)), None)
        if quantity in places:
            both = f'"{names[places[quantity]]}" and "{name}"'
            raise InputError(f"{path}: the columns {both} are both {quantity}: remove one")
        if quantity is not None:
            places[quantity] = index
    return places
