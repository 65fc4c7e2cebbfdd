"""Reads nuScenes' tables: JSON lists of objects. Large tables, some over a gigabyte, are read in batches."""

import re
from collections.abc import Iterator
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


def read_rows(path: Path) -> list[Row]:
    """All rows of a table. Raises InputError if it is missing or not a list."""
    return [row for batch in read_batches(path) for row in batch]


def read_batches(path: Path) -> Iterator[list[Row]]:
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


def column(rows: list[Row], name: str, path: Path) -> list[Any]:
    """The values of a column. Raises InputError if a row does not have it."""
    try:
        return [row[name] for row in rows]
    except (KeyError, TypeError):
        raise InputError(f'{path}: a row has no "{name}" (expected a nuScenes table)') from None


def integers(rows: list[Row], name: str, path: Path) -> NDArray[np.int64]:
    """(N,) int64 values of a column. Raises InputError for anything but integers."""
    values = column(rows, name, path)
    if not set(map(type, values)) <= {int, bool} or max(map(abs, values), default=0) > LARGEST_INTEGER // 1000:
        raise InputError(f'{path}: "{name}": expected an integer of at most 52 bits in every row')
    return np.array(values, dtype=np.int64)


def vectors(rows: list[Row], name: str, path: Path, size: int) -> Array:
    """(N, size) values of a column of number lists. Raises InputError for another length or a non-finite number."""
    values = array_of(column(rows, name, path), (len(rows), size))
    if values is None:
        raise InputError(f'{path}: "{name}": expected {size} finite numbers in every row')
    return values


def quaternions(rows: list[Row], name: str, path: Path) -> Array:
    """(N, 4) w, x, y, z of a column. Raises InputError for a quaternion of norm 0."""
    values = vectors(rows, name, path, 4)
    if not (np.linalg.norm(values, axis=1) > SHORTEST_QUATERNION).all():
        raise InputError(f'{path}: "{name}": expected quaternions of norm 1, found one of norm 0')
    return values


def array_of(value: Any, shape: tuple[int, ...]) -> Array | None:
    """Nested lists as a float64 array of finite numbers of this shape; None if they are not."""
    try:
        array = np.array(value, dtype=np.float64).reshape(shape if 0 in shape else np.shape(value))
    except (ValueError, TypeError, OverflowError):
        return None
    return array if array.shape == shape and (np.abs(array) < LARGEST_NUMBER).all() else None


def texts(rows: list[Row], name: str, path: Path) -> list[str]:
    """The texts of a column, each of at most 400 characters. Raises InputError for anything else."""
    values = column(rows, name, path)
    if not set(map(type, values)) <= {str} or max(map(len, values), default=0) > LONGEST_TEXT:
        raise InputError(f'{path}: "{name}": expected a text of at most {LONGEST_TEXT} characters in every row')
    return values


def by_token(path: Path, name: str) -> dict[str, str]:
    """The texts of a column of a table by the token of their row. Raises InputError as `read_rows` and `texts`."""
    rows = read_rows(path)
    return dict(zip(texts(rows, "token", path), texts(rows, name, path), strict=True))


def tokens(rows: list[Row], name: str, path: Path) -> NDArray[np.bytes_]:
    """(N,) tokens of a column, as bytes. Raises InputError for anything but ASCII texts."""
    try:
        return np.array(texts(rows, name, path), dtype="S") if rows else np.zeros(0, dtype="S32")
    except UnicodeEncodeError:
        raise InputError(f'{path}: "{name}": expected a token of ASCII characters in every row') from None


def places_of(wanted: NDArray[np.bytes_], table: NDArray[np.bytes_], path: Path) -> NDArray[np.int64]:
    """(N,) rows of the wanted tokens (N,) in a table with the tokens (M,). Raises InputError if one is missing."""
    if not len(wanted):
        return np.zeros(0, dtype=np.int64)
    order = np.argsort(table)
    if len(table):
        places = order[np.searchsorted(table, wanted, sorter=order).clip(max=len(table) - 1)]
        unknown = table[places] != wanted
    else:
        places, unknown = np.zeros(len(wanted), dtype=np.int64), np.ones(len(wanted), dtype=bool)
    if unknown.any():
        token = wanted[unknown][0].decode()
        raise InputError(f'{path}: token "{token}" is missing in this table, but another table refers to it')
    return places


def _parse(path: Path, text: bytes) -> list[Row]:
    rows = parse_json(text, path)
    if not isinstance(rows, list) or not all(type(row) is dict for row in rows):
        raise InputError(f"{path}: expected a list of rows (a nuScenes table)")
    return rows
