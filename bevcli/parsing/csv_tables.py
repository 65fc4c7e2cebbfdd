"""Strict CSV tables with a header, with error messages that name line and column."""

import csv
import io
import re
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

from bevcli.errors import InputError
from bevcli.parsing.documents import LARGEST_INTEGER
from bevcli.parsing.files import read_text

LARGEST_BYTES = 256 << 20
NANOSECONDS_FROM = 16  # power of ten; since 1970, fewer nanoseconds ended in April 1970, and more µs in the year 2286
UNITS = {3: "microseconds", 6: "milliseconds", 9: "seconds"}
LARGEST_NUMBER = 1e12  # in SI units, far beyond any position or motion of a vehicle
_FORMULA = re.compile(r"'*[=+\-@\t\r]")  # a spreadsheet would compute a cell such as `=1+1` or `-1`


def cell_of(name: str) -> str:
    """The cell of a name from outside, with an apostrophe in front of what would be a formula."""
    return f"'{name}" if _FORMULA.match(name) else name


def name_of(cell: str) -> str:
    """The name in a cell of `cell_of`."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


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
            raise self.error(column, f'expected an integer, found "{text:.40}": {_advice(text, column)}')
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


def _advice(text: str, column: str) -> str:
    """The way to an integer from a cell that is none: the right number, or that it is lost."""
    try:
        value = Decimal(text if re.fullmatch("[-+.0-9eE]+", text) else "")
    except InvalidOperation:
        return "write digits only"
    if value.as_tuple().exponent > 0 or value.adjusted() > 40:  # type: ignore[operator]
        return "its last digits are lost, as spreadsheets round long numbers: write the table anew from its source"
    power = next((power for power in (0, 3, 6) if value.adjusted() + power >= NANOSECONDS_FROM), 9)
    if not column.endswith("timestamp_ns") or power == 0:
        return f"write {value:.0f}" if value == value.to_integral_value() else "write an integer"
    return f"write nanoseconds: {value.scaleb(power):.0f}, if it is in {UNITS[power]}"


def read_csv(path: Path, required: tuple[str, ...], optional: tuple[str, ...] = ()) -> tuple[CsvRow, ...]:
    """The rows of a CSV file with a header (UTF-8, separated by commas), at least one.

    Raises InputError if the file cannot be read, a required column is missing, a column is unknown or repeated, a row
    has another number of cells than the header, or there are no rows.
    """
    text = read_text(path, LARGEST_BYTES).removeprefix("\ufeff")
    try:
        reader = csv.reader(io.StringIO(text, newline=""))
        lines = [(reader.line_num, cells) for cells in reader if cells]
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read as CSV ({error})") from None
    if not lines:
        raise InputError(f"{path}: the file is empty (expected a header with {', '.join(required)})")
    columns = [name_of(cell.strip()) for cell in lines[0][1]]
    _check_columns(path, columns, required, optional)
    rows = tuple(_row(path, columns, line, cells) for line, cells in lines[1:])
    if not rows:
        raise InputError(f"{path}: the table has no rows below the header (expected at least one)")
    return rows


def _check_columns(path: Path, columns: list[str], required: tuple[str, ...], optional: tuple[str, ...]) -> None:
    missing = [name for name in required if name not in columns]
    if missing and len(columns) == 1:
        for character, name in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars")):
            if character in columns[0]:
                raise InputError(f"{path}: the columns are separated by {name} (expected commas): save it with commas")
    if missing:
        raise InputError(f'{path}: column "{missing[0]}" is missing (found: {", ".join(columns)})')
    for name in columns:
        if name not in required and name not in optional:
            raise InputError(f'{path}: unknown column "{name}" (known: {", ".join((*required, *optional))})')
        if columns.count(name) > 1:
            raise InputError(f'{path}: column "{name}" appears twice in the header')


def _row(path: Path, columns: list[str], line: int, cells: list[str]) -> CsvRow:
    if any("\0" in cell for cell in cells):
        raise InputError(f"{path}: line {line}: has a null byte (expected text; the file may be damaged)")
    if len(cells) != len(columns):
        raise InputError(f"{path}: line {line} has {len(cells)} cells (expected {len(columns)}, as in the header)")
    return CsvRow(path, line, {name: name_of(cell.strip()) for name, cell in zip(columns, cells, strict=True)})
