"""A JSON file that is written entry by entry, and that loses no entry whatever ends the program.

While it is written, the file has the suffix ".partial" and only grows: the head, then one entry a line. `close` appends
the tail and renames it. A partial file lacks its tail; `read_entries` adds it.
"""

import contextlib
import json
import os
from pathlib import Path
from typing import Any

from bevcli.errors import InputError, OutputError
from bevcli.parsing.documents import parse_json
from bevcli.parsing.files import read_bytes

PARTIAL = ".partial"


class GrowingFile:
    """A file that gets each piece whole or not at all, also on a full disk, and that can be resumed.

    Attributes:
        path: where it is.
        name: the path in error messages.
        size: bytes written so far. Pass it as `resume_at` to go on from here.
    """

    def __init__(self, path: Path, resume_at: int | None = None, name: Path | None = None) -> None:
        """Creates the file, or cuts it to `resume_at` bytes and goes on there. Raises OutputError."""
        self.path, self.name = path, path if name is None else name
        self.size = 0
        try:
            # Unbuffered: a piece is in the file at once.
            self._file = path.open("wb" if resume_at is None else "r+b", buffering=0)
            if resume_at is not None:
                self._file.truncate(resume_at)
                self.size = self._file.seek(resume_at)
        except OSError as error:
            raise self._failure(error) from None

    def append(self, content: bytes | memoryview) -> None:
        """Writes a piece. Raises OutputError; the file then is as before."""
        try:
            rest = memoryview(content)
            while rest:
                rest = rest[os.write(self._file.fileno(), rest) :]
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.truncate(self.size)
                self._file.seek(self.size)
            raise self._failure(error) from None
        self.size += len(content)

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def is_deleted(self) -> bool:
        """True if somebody has deleted the file while it is written."""
        return os.fstat(self._file.fileno()).st_nlink == 0

    def _failure(self, error: OSError) -> OutputError:
        return OutputError(f"{self.name}: cannot be written ({error.strerror})")


def partial_path(path: Path) -> Path:
    """The name of a file while it is written."""
    return path.with_name(path.name + PARTIAL)


def existing(path: Path) -> Path:
    """The file; where there is only the partial file of a program that was killed, that one."""
    partial = partial_path(path)
    return partial if partial.is_file() and not path.exists() else path


def read_entries(path: Path, tail: str, largest: int, *, missing: str = "the file is missing") -> Any:
    """The contents of an incremental JSON file. A partial file gets its tail, and loses an entry that was cut off.

    largest: its largest size in bytes. missing: text of the message for a file that is not there.
    Raises InputError.
    """
    file = existing(path)
    content = read_bytes(file, largest, missing=missing)
    if file.suffix == PARTIAL:
        if not content:
            raise InputError(f"{file}: is empty: the run ended before its first frame")
        content = _without_cut_entry(content) + tail.encode()
    return parse_json(content, path)


def _without_cut_entry(content: bytes) -> bytes:
    lines = content.rstrip(b",\n")
    kept, newline, last = lines.rpartition(b"\n")
    if not newline or _is_entry(last):
        return lines
    return kept.rstrip(b",")


def _is_entry(line: bytes) -> bool:
    for text in (line, b"{" + line + b"}"):  # an entry of a list, or a member of an object
        with contextlib.suppress(ValueError):
            json.loads(text)
            return True
    return False


class IncrementalJson:
    """Writes entries between a head and a tail, and keeps none of them in memory. `path` exists once it is closed."""

    def __init__(self, path: Path, head: str, tail: str, resume_at: int | None = None) -> None:
        """Creates the file. Head and tail together must be valid JSON.

        resume_at: the `size` of an earlier writer of this file: keep what it had written then, and go on.
        Raises OutputError if the file cannot be written.
        """
        self.path = path
        self._partial = partial_path(path)
        self._tail = f"\n{tail}\n".encode()
        self._separator = "\n"
        self._is_closed = False
        if resume_at is not None and not self._partial.exists() and path.exists():
            _rename(path, self._partial)
        self._file = GrowingFile(self._partial, resume_at, name=path)
        if resume_at is None:
            self._file.append(head.encode())
        elif resume_at > len(head.encode()):
            self._separator = ",\n"

    @property
    def size(self) -> int:
        """Bytes of the head and the entries written so far. Pass it as `resume_at` to go on from here."""
        return self._file.size

    def append(self, entry: Any, name: str, key: str | None = None) -> None:
        """Write an entry.

        name: what the entry is, for error messages. key: its key, if the entries are members of an object.
        Raises OutputError for NaN or infinity, or if the file cannot be written. The file then keeps what it had.
        """
        try:
            text = json.dumps(entry, allow_nan=False)
        except ValueError:
            raise OutputError(
                f"{self.path}: {name}: a box or pose has a number that is not finite, so the model's output is "
                'invalid: try `precision="fp32"`'
            ) from None
        member = text if key is None else f"{json.dumps(key)}: {text}"
        self._file.append((self._separator + member).encode())
        self._separator = ",\n"

    def close(self) -> None:
        """Completes the file and gives it its name. Raises OutputError; the partial file then keeps all entries."""
        if self._is_closed:
            return
        self._is_closed = True
        try:
            self._file.append(self._tail)
        finally:
            self._file.close()
        _rename(self._partial, self.path)

    def is_deleted(self) -> bool:
        """True if somebody has deleted the file that is being written."""
        return self._file.is_deleted()


def _rename(path: Path, to: Path) -> None:
    try:
        os.replace(path, to)
    except OSError as error:
        raise OutputError(f"{to}: cannot be written ({error.strerror})") from None
