"""Reads nuScenes' tables: JSON lists of objects. Large tables, some over a gigabyte, are read in batches."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array
from bevcli.parsing.documents import LARGEST_INTEGER, parse_json
from bevcli.parsing.files import open_regular, read_bytes

Row: TypeAlias = dict[str, Any]
BATCH_BYTES = 16 << 20
LONGEST_TEXT = 400  # characters of a token, name or path
LARGEST_NUMBER = 1e12  # metres or pixels
SHORTEST_QUATERNION = 1e-3
# The text between two rows. Rows of large tables contain no objects and no free text, so it occurs nowhere else.
BETWEEN_ROWS = re.compile(rb"}\s*,\s*{")
TAIL_BYTES = 1 << 14  # the end of a batch in which its last complete row ends; no row is longer


@dataclass(frozen=True)
class Rows:
    """Rows of a table. Its columns are checked when they are asked for: each method raises InputError for wrong values.

    path: of the table, for messages.
    """

    path: Path
    rows: list[Row]

    def __len__(self) -> int:
        return len(self.rows)

    def where(self, kept: Iterable[object]) -> "Rows":
        """Some of the rows. kept: a value for each row, which is true for those."""
        return Rows(self.path, list(compress(self.rows, kept)))

    def column(self, name: str) -> list[Any]:
        """The values of a column, which every row must have."""
        try:
            return [row[name] for row in self.rows]
        except (KeyError, TypeError):
            raise self._error(f'a row has no "{name}" (expected a nuScenes table)') from None

    def integers(self, name: str) -> NDArray[np.int64]:
        """(N,) int64 values of a column."""
        values = self.column(name)
        if not set(map(type, values)) <= {int, bool} or max(map(abs, values), default=0) > LARGEST_INTEGER // 1000:
            found = next(one for one in values if type(one) not in (int, bool) or abs(one) > LARGEST_INTEGER // 1000)
            unit = ": give microseconds, not seconds" if type(found) is float and 1e8 < found < 1e11 else ""
            raise self._error(
                f'"{name}": expected an integer of at most 52 bits in every row, found {found!r:.40}{unit}'
            )
        return np.array(values, dtype=np.int64)

    def vectors(self, name: str, size: int) -> Array:
        """(N, size) finite values of a column of number lists."""
        values = array_of(self.column(name), (len(self), size))
        if values is None:
            raise self._error(f'"{name}": expected {size} finite numbers in every row')
        return values

    def quaternions(self, name: str) -> Array:
        """(N, 4) w, x, y, z of a column, with norms above 0."""
        values = self.vectors(name, 4)
        if not (np.linalg.norm(values, axis=1) > SHORTEST_QUATERNION).all():
            raise self._error(f'"{name}": expected quaternions of norm 1, found one of norm 0')
        return values

    def texts(self, name: str) -> list[str]:
        """The texts of a column, each of at most 400 characters."""
        values = self.column(name)
        if not set(map(type, values)) <= {str} or max(map(len, values), default=0) > LONGEST_TEXT:
            raise self._error(f'"{name}": expected a text of at most {LONGEST_TEXT} characters in every row')
        return values

    def by_token(self, name: str) -> dict[str, str]:
        """The texts of a column by the token of their row."""
        return dict(zip(self.texts("token"), self.texts(name), strict=True))

    def tokens(self, name: str) -> NDArray[np.bytes_]:
        """(N,) tokens of a column, ASCII texts, as bytes."""
        try:
            return np.array(self.texts(name), dtype="S") if self.rows else np.zeros(0, dtype="S32")
        except UnicodeEncodeError:
            raise self._error(f'"{name}": expected a token of ASCII characters in every row') from None

    def _error(self, problem: str) -> InputError:
        return InputError(f"{self.path}: {problem}")


def read_rows(path: Path) -> Rows:
    """All rows of a table. Raises InputError if it is missing or not a list."""
    return Rows(path, [row for batch in read_batches(path) for row in batch.rows])


def read_batches(path: Path) -> Iterator[Rows]:
    """The rows of a table, tens of thousands at a time. Raises InputError as `read_rows`."""
    if not path.is_file():
        raise InputError(f"{path}: the table is missing (expected a nuScenes table)")
    if path.stat().st_size <= BATCH_BYTES:
        yield _parse(path, read_bytes(path, BATCH_BYTES))
        return
    with open_regular(path) as file:
        rest = file.read(BATCH_BYTES).lstrip()[1:]  # without the list's opening bracket
        while block := file.read(BATCH_BYTES):
            text = rest + block
            ends = [found.start() + 1 for found in BETWEEN_ROWS.finditer(text, max(0, len(text) - TAIL_BYTES))]
            cut = ends[-1] if ends else 0
            yield _parse(path, b"[" + text[:cut] + b"]")
            rest = text[cut:].lstrip()[1:]  # without the comma
        yield _parse(path, b"[" + rest)


def array_of(value: Any, shape: tuple[int, ...]) -> Array | None:
    """Nested lists as a float64 array of finite numbers of this shape; None if they are not."""
    try:
        array = np.array(value, dtype=np.float64).reshape(shape if 0 in shape else np.shape(value))
    except (ValueError, TypeError, OverflowError):
        return None
    return array if array.shape == shape and (np.abs(array) < LARGEST_NUMBER).all() else None


def places_of(wanted: NDArray[np.bytes_], table: NDArray[np.bytes_], path: Path) -> NDArray[np.int64]:
    """(N,) rows of the wanted tokens (N,) in a table with the tokens (M,). Raises InputError if one is missing."""
    places, unknown = np.zeros(0, dtype=np.int64), wanted  # of a table without rows
    if len(table):
        order = np.argsort(table)
        places = order[np.searchsorted(table, wanted, sorter=order).clip(max=len(table) - 1)]
        unknown = wanted[table[places] != wanted]
    if len(unknown):
        token = unknown[0].decode()
        raise InputError(f'{path}: token "{token}" is missing in this table, but another table refers to it')
    return places


def _parse(path: Path, text: bytes) -> Rows:
    rows = parse_json(text, path)
    if not isinstance(rows, list) or not all(type(row) is dict for row in rows):
        raise InputError(f"{path}: expected a list of rows (a nuScenes table)")
    return Rows(path, rows)
