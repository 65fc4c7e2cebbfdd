"""A JSON file of many entries that is whole and valid after every one of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from bevcli.errors import OutputError


class GrowingJson:
    """Entries between a head and a tail; each is written over the tail, which follows it again, in one write.

    A program that is killed leaves the entries it has done. Nothing is kept in memory.
    """

    def __init__(self, path: Path, head: str, tail: str) -> None:
        """Head and tail together are valid JSON. Raises OutputError where the file cannot be written."""
        self.path = path
        self._tail = f"\n{tail}\n".encode()
        self._separator = "\n"
        self._end = 0
        try:
            self._file = path.open("wb", buffering=0)  # unbuffered: what is written is in the file
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
        self._write(head)

    def append(self, entry: Any, name: str, key: str | None = None) -> None:
        """Add an entry, with its key where the entries are an object's. name: what it is, for an error.

        Raises OutputError where it holds NaN or infinity; the file then keeps what it had.
        """
        try:
            text = json.dumps(entry, allow_nan=False)
        except ValueError:
            raise OutputError(
                f"{self.path}: {name}: a box or pose has a number that is not finite: the model's output is broken "
                "(try --precision fp32)"
            ) from None
        self._write(self._separator + ("" if key is None else f"{json.dumps(key)}: ") + text)
        self._separator = ",\n"

    def close(self) -> None:
        """Close the file, which is whole already."""
        self._file.close()

    def _write(self, addition: str) -> None:
        encoded = addition.encode()
        try:
            self._file.seek(self._end)
            self._file.write(encoded + self._tail)
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written ({error.strerror})") from None
        self._end += len(encoded)
