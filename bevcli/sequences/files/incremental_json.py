"""A JSON file that is written entry by entry and is valid after each of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from bevcli.errors import OutputError


class IncrementalJson:
    """Writes entries between a head and a tail. Each write replaces the tail with an entry and the tail.

    If the program is killed, the file still has all entries written so far. Entries are not kept in memory.
    """

    def __init__(self, path: Path, head: str, tail: str) -> None:
        """Create the file. Head and tail together must be valid JSON. Raises OutputError if it cannot be written."""
        self.path = path
        self._tail = f"\n{tail}\n".encode()
        self._separator = "\n"
        self._end = 0
        try:
            self._file = path.open("wb", buffering=0)  # unbuffered: a written entry is in the file at once
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
        self._write(head)

    def append(self, entry: Any, name: str, key: str | None = None) -> None:
        """Write an entry.

        name: what the entry is, for error messages. key: its key, if the entries are members of an object.
        Raises OutputError for NaN or infinity, and leaves the file unchanged, or if it cannot be written.
        """
        try:
            text = json.dumps(entry, allow_nan=False)
        except ValueError:
            raise OutputError(
                f"{self.path}: {name}: a box or pose has a number that is not finite, so the model's output is "
                "invalid: try --precision fp32"
            ) from None
        self._write(self._separator + ("" if key is None else f"{json.dumps(key)}: ") + text)
        self._separator = ",\n"

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _write(self, addition: str) -> None:
        encoded = addition.encode()
        try:
            self._file.seek(self._end)
            self._file.write(encoded + self._tail)
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written ({error.strerror})") from None
        self._end += len(encoded)
