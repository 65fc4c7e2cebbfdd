"""Reads Feather tables with pyarrow, which rerun brings, so that it is installed anyway."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array
from bevcli.parsing.files import MIB, read_bytes
from bevcli.printing import reason_of

LARGEST_BYTES = 256 * MIB
LARGEST_NUMBER = 1e12  # metres or pixels
SHORTEST_QUATERNION = 1e-3
QUATERNION, TRANSLATION = ("qw", "qx", "qy", "qz"), ("tx_m", "ty_m", "tz_m")


class FeatherTable:
    """The columns of a Feather file. Raises InputError where the file is missing or broken, or lacks a column.

    required: names of columns.
    """

    def __init__(self, path: Path, required: Iterable[str]) -> None:
        self.path = path
        data = read_bytes(path, LARGEST_BYTES)
        try:
            self._table = pa.ipc.open_file(pa.BufferReader(data)).read_all()
            self._table.validate(full=True)
        except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
            raise InputError(f"{path}: is not a complete Feather file ({reason_of(error)[:200]})") from None
        for name in required:
            if self._table.column_names.count(name) != 1:
                found = ", ".join(self._table.column_names[:20])
                raise InputError(f'{path}: has no column "{name:.60}" (found: {found:.200})')

    def __len__(self) -> int:
        return int(self._table.num_rows)

    def numbers(self, names: Iterable[str]) -> Array:
        """(N, C) finite values of columns of numbers. Raises InputError."""
        return np.stack([self._numbers(name) for name in names], axis=1)

    def integers(self, name: str) -> NDArray[np.int64]:
        """(N,) values of a column of integers. Raises InputError."""
        column = self._table[name]
        if not pa.types.is_integer(column.type) or column.null_count:
            raise self._error(name, "integers", column)
        try:
            return column.cast(pa.int64()).to_numpy().astype(np.int64)
        except pa.ArrowException:
            raise self._error(name, "integers of at most 63 bits", column) from None

    def texts(self, name: str) -> list[str]:
        """(N) values of a column of texts. Raises InputError."""
        column = self._table[name]
        try:
            texts = column.cast(pa.string()).to_pylist()
        except pa.ArrowException:
            raise self._error(name, "texts", column) from None
        if column.null_count or any(len(text) > 200 for text in texts):
            raise self._error(name, "texts of at most 200 characters", column)
        return [str(text) for text in texts]

    def poses(self) -> tuple[Array, Array]:
        """(N, 3) translations, metres, and (N, 4) quaternions w, x, y, z of norm 1. Raises InputError."""
        quaternions = self.numbers(QUATERNION)
        norms = np.linalg.norm(quaternions, axis=1, keepdims=True)
        if not (norms > SHORTEST_QUATERNION).all():
            raise InputError(f"{self.path}: expected quaternions of norm 1, found one of norm 0")
        return self.numbers(TRANSLATION), quaternions / norms

    def _numbers(self, name: str) -> Array:
        column = self._table[name]
        if not (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)) or column.null_count:
            raise self._error(name, "numbers", column)
        values = column.to_numpy().astype(np.float64)
        if not (np.abs(values) < LARGEST_NUMBER).all():
            raise self._error(name, "finite numbers below 1e12", column)
        return values

    def _error(self, name: str, expected: str, column: pa.ChunkedArray) -> InputError:
        found = f"{column.type}{' with missing values' if column.null_count else ''}"
        return InputError(f'{self.path}: column "{name}": expected {expected}, found {found:.80}')
