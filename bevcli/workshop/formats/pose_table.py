"""Tables of poses: the names of their columns, and their cells."""

import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array
from bevcli.parsing.documents import CsvRow, parse_numbers_at_once
from bevcli.workshop.formats.pose_texts import table_text

VECTOR, QUATERNION = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
MATRIX = tuple(f"m{row}{column}" for row in range(3) for column in range(4))  # world_from_camera, row by row
TUM = ("time", *VECTOR, "qx", "qy", "qz", "qw")
BLOCK = 65_536  # rows whose places in the text are made numbers at once
_LINE = re.compile(r"([^\r\n]*)(?:\r\n|\r|\n|\Z)")
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
        places: index of the column of each quantity.
        text: the text of the file.
        spans: (T, 3) of each row: its line from 1, its start in the text and its end.
        separator: of the columns; None for spaces.
        values: (T,) numbers that take the place of a column, or are a new one.
        notes: how its numbers were understood.
    """

    path: Path
    columns: dict[str, str]
    places: Mapping[str, int]
    text: str
    spans: NDArray[np.int64]
    separator: str | None
    values: Mapping[str, Array] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.spans)

    def has(self, *names: str) -> bool:
        """True where it has all of these quantities."""
        return all(name in self.columns for name in names)

    def rows(self) -> Iterator[CsvRow]:
        """All rows, each made when it is asked for: those of a million would fill the memory."""
        return map(self.row, range(len(self)))

    def row(self, index: int) -> CsvRow:
        """The cells of a row by quantity. index: from 0."""
        line, *span = self.spans[index].tolist()
        cells = _cells(self._text(span), self.separator)
        made = {name: cells[place] for name, place in self.places.items()}
        return CsvRow(
            self.path, line, made | {name: repr(float(column[index])) for name, column in self.values.items()}
        )

    def texts(self, name: str) -> Iterator[str]:
        """The cells of a column of the file."""
        place = self.places[name]
        return (_plain(line.split(self.separator, place + 1)[place]) for line in self.lines())

    def lines(self) -> Iterator[str]:
        """The lines of the rows, with points in numbers."""
        for first in range(0, len(self), BLOCK):
            yield from map(self._text, self.spans[first : first + BLOCK, 1:].tolist())

    def numbers(self, *names: str) -> Array:
        """(T, N) quantities; 0 where the table lacks one. Raises InputError that names line and column."""
        places = {name: self.places[name] for name in names if name in self.columns and name not in self.values}
        types = np.dtype([(name, "f8") for name in places])
        table = (
            parse_numbers_at_once(self.lines(), types, self.separator, places=[*places.values()]) if places else None
        )
        if table is None:
            table = np.zeros(len(self), types)
            for index, row in enumerate(self.rows() if places else ()):
                table[index] = tuple(row.number(name) for name in places)
        given = {**{name: table[name] for name in places}, **self.values}
        return np.stack([given.get(name, np.zeros(len(self))) for name in names], axis=1)

    def _text(self, span: list[int]) -> str:
        line = self.text[slice(*span)].strip()
        return line.replace(",", ".") if self.separator in (";", "\t") else line


def read_table(path: Path) -> Table | None:
    """The cells of a text file with columns; None where it has no rows, or not two columns that are known.

    Names of columns stand in the line above the rows, which may be a comment. Raises InputError for a row with another
    number of cells.
    """
    text, header, spans = table_text(path), "", array("q")
    for number, match in enumerate(_LINE.finditer(text), 1):
        line = match[1].strip()
        if line.startswith(("#", "%")) or (not spans and re.match("[\"'A-Za-z_]", line)):
            header = header if spans else line.lstrip("#% ").lower()
        elif line:
            spans.extend((number, *match.span(1)))
    if not spans:
        return None
    first = text[spans[1] : spans[2]].strip()
    separator = next((sign for sign in (";", "\t", ",") if sign in first), None)
    count = len(_cells(first, separator))
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
    columns = {quantity: names[index] for quantity, index in places.items()}
    table = Table(path, columns, places, text, np.array(spans).reshape(-1, 3), separator)
    for index, line in enumerate(table.lines()):
        if (found := len(_split(line, separator))) != count:
            number = table.spans[index, 0]
            raise InputError(f"{path}: line {number} has {found} cells (expected {count}, as in the first row)")
    return table


def _cells(text: str, separator: str | None) -> list[str]:
    return [_plain(cell) for cell in _split(text, separator)]


def _split(text: str, separator: str | None) -> list[str]:
    cells = text.strip().split(separator)
    return cells[:-1] if cells and not _plain(cells[-1]) else cells


def _plain(cell: str) -> str:
    return cell.strip().strip("\"'")


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
