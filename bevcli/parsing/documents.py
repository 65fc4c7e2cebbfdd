"""JSON, TOML and CSV with limits on nesting and on the size of numbers.

Parsers refuse a broken text, but many well-formed texts break the code behind them: lists nested a thousand levels
deep, integers that no array can hold. They are refused here, for all readers.
"""

import csv
import gc
import io
import json
import re
import tomllib
import warnings
from collections.abc import Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import BevcliError, InputError
from bevcli.parsing.files import MIB, read_bytes
from bevcli.printing import name_of, reason_of, shortened

DEEPEST = 64  # levels of nested lists and objects
LARGEST_INTEGER = 2**62  # the difference of two such integers still fits 64 bits
JSON_BYTES, TOML_BYTES = 64 * MIB, MIB
MOST_VALUES = 200_000  # of a TOML or YAML file
_BRACKETS = b"[]{}"
_NO_BRACKETS = bytes(set(range(256)) - set(_BRACKETS))
_STRING = re.compile(rb'"(?:[^"\\]|\\.)*+"', re.DOTALL)
_DIGITS_TO_ZERO = bytes.maketrans(b"123456789", b"000000000")
CSV_BYTES = 256 << 20
NANOSECONDS_FROM = 16  # power of ten; since 1970, fewer nanoseconds ended in April 1970, and more µs in the year 2286
UNITS = {3: "microseconds", 6: "milliseconds", 9: "seconds"}
LARGEST_NUMBER = 1e12  # in SI units, far beyond any position or motion of a vehicle
# Members of objects in JSON, see `typed`. Numbers may be NaN.
Number = Annotated[float, msgspec.Meta(gt=-LARGEST_NUMBER, lt=LARGEST_NUMBER)]
Text = Annotated[str, msgspec.Meta(min_length=1, max_length=400)]
_Form = TypeVar("_Form")

# Numbers of a configuration with their range, which `bevcli.config` holds a file to.
Count = Annotated[int, msgspec.Meta(ge=1)]
CountOrNone = Annotated[int, msgspec.Meta(ge=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
ShareBelowOne = Annotated[float, msgspec.Meta(ge=0, lt=1)]


def read_json(
    path: Path,
    *,
    largest: int = JSON_BYTES,
    missing: str = "the file is missing",
) -> Any:
    """The contents of a JSON file. Raises InputError.

    Args:
        path: the file.
        largest: its largest size in bytes.
        missing: text of the message for a file that is not there.
    """
    return parse_json(read_bytes(path, largest, missing=missing), path)


def parse_json(text: bytes, path: Path, *, namespaces: bool = False, keys_checked: bool = True) -> Any:
    """Parses JSON: at most 64 nested levels, integers of at most 62 bits, no key twice in an object.

    namespaces: objects become `SimpleNamespace`, not dicts. keys_checked: False for a large file of a program,
    which takes half as long again with it.
    Raises InputError, which names `path`.
    """
    without_strings = _STRING.sub(b"", text) if _depth(text) > DEEPEST else b""
    if _depth(without_strings) > DEEPEST:
        raise InputError(f"{path}: is nested too deeply (expected at most {DEEPEST} levels of lists and objects)")

    def integer(digits: str) -> int:
        if len(digits) > 20 or abs(int(digits)) > LARGEST_INTEGER:
            raise InputError(f"{path}: the integer {digits:.24} is too large (expected at most 62 bits)")
        return int(digits)

    def members(pairs: list[tuple[str, Any]]) -> Any:
        members = dict(pairs)
        if len(members) < len(pairs):
            keys = [key for key, _ in pairs]
            twice = keys[first_twice(keys) or 0]
            raise InputError(f'{path}: "{twice:.60}" appears twice in the same object: remove or rename one')
        return SimpleNamespace(**members) if namespaces else members

    # A Python function for integers makes parsing slow, and only a long row of digits needs it.
    long_number = b"0" * 19 in text.translate(_DIGITS_TO_ZERO)
    try:
        hook = members if keys_checked else None
        document = json.loads(text, object_pairs_hook=hook, parse_int=integer if long_number else None)
        if b"\\u" in text:  # an escape may be half of a character, which no file or terminal takes
            json.dumps(document, ensure_ascii=False, default=vars).encode()
        return document
    except json.JSONDecodeError as error:
        position = f"line {error.lineno}, column {error.colno}"
        raise InputError(f"{path}: {position}: broken JSON: {error.msg}") from None
    except UnicodeError as error:
        raise InputError(f"{path}: cannot be read as JSON ({reason_of(error)[:200]})") from None


def typed(value: Any, form: type[_Form], location: object) -> _Form:
    """A value of a JSON, YAML or TOML file as a type of msgspec. Raises InputError, which names the place in it.

    location: the file, and the place of the value in it.
    """
    try:
        return msgspec.convert(value, form)
    except msgspec.ValidationError as error:
        problem, _, place = str(error).partition(" - at `$")
        place = place.removesuffix("`").replace(".", ": ", place.startswith("."))
        raise InputError(f"{location}{place}: {problem[:1].lower()}{problem[1:]}") from None


def first_twice(keys: Sequence[Hashable]) -> int | None:
    """The index of the first key that stands earlier in the sequence too; None where each is there once."""
    if len(set(keys)) == len(keys):
        return None
    return next(index for index, key in enumerate(keys) if key in keys[:index])


def parse_toml(text: str, path: str | Path, error: type[BevcliError] = InputError) -> dict[str, Any]:
    """Parses TOML. Raises `error`, which names `path`."""
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as failure:
        raise error(f"{path}: invalid TOML: {failure}") from None
    except (ValueError, RecursionError, OverflowError) as failure:  # impossible dates, thousands of digits or brackets
        raise error(f"{path}: cannot be read as TOML ({reason_of(failure)[:200]})") from None
    check_values(document, path, error)
    return document


def check_values(document: Any, path: str | Path, error: type[BevcliError] = InputError) -> None:
    """Raises `error` where a parsed document is nested too deeply or contains an integer beyond 62 bits."""
    level = [document]
    count = 0
    for _ in range(DEEPEST + 1):
        below: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                below += [*value.keys(), *value.values()]
            elif isinstance(value, list | tuple | set):
                below += value
            elif isinstance(value, int) and abs(value) > LARGEST_INTEGER:
                raise error(f"{path}: an integer is too large (expected at most 62 bits)")
            if len(below) > MOST_VALUES:
                break
        if not below:
            return
        count += len(below)
        if count > MOST_VALUES:  # YAML's aliases can repeat a list in a list in a list
            raise error(f"{path}: has more than {MOST_VALUES} values, aliases written out")
        level = below
    raise error(f"{path}: is nested too deeply (expected at most {DEEPEST} levels)")


def _depth(text: bytes) -> int:
    """The deepest nesting of brackets, those in strings included."""
    brackets = np.frombuffer(text.translate(None, _NO_BRACKETS), dtype=np.uint8)
    if not len(brackets):
        return 0
    opening = (brackets == ord("[")) | (brackets == ord("{"))
    return int(np.cumsum(np.where(opening, 1, -1), dtype=np.int32).max())


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Inside the block, the collector does not run: it would scan all parsed JSON objects again and again.

    Without it, reading a boxes file takes half the time, and nuScenes tables two thirds.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


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
    """All rows of a CSV file, see `csv_rows`."""
    return tuple(csv_rows(path, required, optional))


def csv_rows(
    path: Path, required: tuple[str, ...], optional: tuple[str, ...] = (), *, may_be_empty: bool = False
) -> Iterator[CsvRow]:
    """The rows of a CSV file with a header (UTF-8, separated by commas), at least one by default, while it is parsed.

    Raises InputError if the file cannot be read, a required column is missing, a column is unknown or repeated, a row
    has another number of cells than the header, or there are no rows.
    """
    content = read_bytes(path, CSV_BYTES)
    reader = csv.reader(io.TextIOWrapper(io.BytesIO(content), "utf-8-sig", newline=""))
    lines = (cells for cells in reader if cells)
    try:
        header = next(lines, None)
        if header is None:
            raise InputError(f"{path}: the file is empty (expected a header with {', '.join(required)})")
        columns, is_empty = _columns(path, header, required, optional), True
        for cells in lines:
            if any("\0" in cell for cell in cells):
                raise InputError(
                    f"{path}: line {reader.line_num}: has a null byte (expected text; the file may be damaged)"
                )
            if len(cells) != len(columns):
                found = f"has {len(cells)} cells (expected {len(columns)}, as in the header)"
                raise InputError(f"{path}: line {reader.line_num} {found}")
            yield CsvRow(
                path,
                reader.line_num,
                {name: name_of(cell.strip()) for name, cell in zip(columns, cells, strict=True)},
            )
            is_empty = False
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read as CSV ({error})") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: cannot be read as text ({error})") from None
    if is_empty and not may_be_empty:
        raise InputError(f"{path}: the table has no rows below the header (expected at least one)")


def parse_numbers_at_once(
    lines: Iterable[str],
    types: np.dtype[Any],
    separator: str | None,
    *,
    places: Sequence[int] | None = None,
    skipped: int = 0,
) -> NDArray[Any] | None:
    """(T,) rows of numbers with named columns; None where a cell is no number as `CsvRow` takes it.

    types: of the columns, integers or floats. separator: None for spaces. places: of the columns; None for all that
    the lines have. skipped: lines above the rows.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # an integer with a point
            table = np.loadtxt(
                lines,
                types,
                delimiter=separator,
                usecols=places,
                skiprows=skipped,
                comments=None,
                ndmin=1,
                encoding=None,
            )
    except (ValueError, OverflowError, Warning):
        return None
    floats = [name for name in types.names or () if types[name].kind == "f"]
    return table if all((np.abs(table[name]) < LARGEST_NUMBER).all() for name in floats) else None


def _columns(path: Path, header: list[str], required: tuple[str, ...], optional: tuple[str, ...]) -> list[str]:
    """The names of the columns. Raises InputError."""
    columns = [name_of(cell.strip()) for cell in header]
    missing = [name for name in required if name not in columns]
    if missing and len(columns) == 1:
        for character, name in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars")):
            if character in columns[0]:
                raise InputError(f"{path}: the columns are separated by {name} (expected commas): save it with commas")
    if missing:
        raise InputError(f'{path}: column "{missing[0]}" is missing (found: {shortened(columns)})')
    for name in columns:
        if name not in required and name not in optional:
            raise InputError(f'{path}: unknown column "{name:.60}" (known: {", ".join((*required, *optional))})')
        if columns.count(name) > 1:
            raise InputError(f'{path}: column "{name}" appears twice in the header')
    return columns
