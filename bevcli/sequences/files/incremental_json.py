"""A JSON file that is written entry by entry, and that loses no entry whatever ends the program.

While it is written, the file has the suffix ".partial" and only grows: the head, then one entry a line. `close` appends
the tail and renames it. A partial file lacks its tail; `read_entries` adds it.
"""

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from msgspec import Struct

from bevcli.errors import InputError, OutputError
from bevcli.frame import FrameStamp
from bevcli.parsing.documents import parse_json, typed
from bevcli.parsing.files import read_bytes
from bevcli.writing import PARTIAL, output_errors, partial_path

LARGEST_BYTES = 4 << 30


class GrowingFile:
    """A file that gets each piece whole or not at all, also on a full disk, and that can be resumed.

    It is closed by `close`, or at the end of a `with` block.

    Attributes:
        path: where it is.
        name: the path in error messages.
        size: bytes written so far. Pass it as `resume_at` to go on from here.
    """

    def __init__(self, path: Path, resume_at: int | None = None, name: Path | None = None) -> None:
        """Creates the file, or cuts it to `resume_at` bytes and goes on there. Raises OutputError."""
        self.path, self.name = path, path if name is None else name
        self.size = 0
        with output_errors(self.name):
            # Unbuffered: a piece is in the file at once.
            self._file = path.open("wb" if resume_at is None else "r+b", buffering=0)
            if resume_at is not None:
                self._file.truncate(resume_at)
                self.size = self._file.seek(resume_at)

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
            raise OutputError(f"{self.name}: cannot be written ({error.strerror})") from None
        self.size += len(content)

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def is_deleted(self) -> bool:
        """True if somebody has deleted the file while it is written."""
        return os.fstat(self._file.fileno()).st_nlink == 0


def existing(path: Path) -> Path:
    """The file; where there is only the partial file of a program that was killed, that one."""
    partial = partial_path(path)
    return partial if partial.is_file() and not path.exists() else path


def read_entries(path: Path, brackets: str = "[]", *, missing: str = "the file is missing") -> Any:
    """The contents of an incremental JSON file. A partial file gets its tail, and loses an entry that was cut off.

    brackets: see `IncrementalJson`. missing: text of the message for a file that is not there. Raises InputError.
    """
    file = existing(path)
    content = read_bytes(file, LARGEST_BYTES, missing=missing)
    if file.suffix == PARTIAL:
        if not content:
            raise InputError(f"{file}: is empty: the run ended before its first frame")
        content = _without_cut_entry(content, brackets.encode()) + f"{brackets[1]}}}".encode()
    return parse_json(content, path)


def _without_cut_entry(content: bytes, brackets: bytes) -> bytes:
    lines = content.rstrip(b",\n")
    kept, newline, last = lines.rpartition(b"\n")
    try:
        if newline:
            json.loads(brackets[:1] + last + brackets[1:])
    except ValueError:
        return kept.rstrip(b",")
    return lines


class IncrementalJson(GrowingFile):
    """Writes entries between a head and a tail, and keeps none of them in memory. `name` exists once it is closed."""

    def __init__(
        self, path: Path, head: Mapping[str, Any], key: str, resume_at: int | None = None, brackets: str = "[]"
    ) -> None:
        """Creates the file: an object with the members of the head, and the entries in a list or object under the key.

        resume_at: the `size` of an earlier writer of this file: keep what it had written then, and go on. brackets:
        around the entries, "[]" or "{}".
        Raises OutputError if the file cannot be written.
        """
        start = f'{json.dumps(head)[:-1]}, "{key}": {brackets[0]}'.encode()
        partial = partial_path(path)
        if resume_at is not None and not partial.exists() and path.exists():
            with output_errors(partial):
                os.replace(path, partial)
        super().__init__(partial, resume_at, name=path)
        self._tail = f"\n{brackets[1]}}}\n".encode()
        if resume_at is None:
            self.append(start)
        self._separator = ",\n" if self.size > len(start) else "\n"

    def add(self, entry: Any, name: str, key: str | None = None) -> None:
        """Write an entry.

        name: what the entry is, for error messages. key: its key, if the entries are members of an object.
        Raises OutputError for NaN or infinity, or if the file cannot be written. The file then keeps what it had.
        """
        try:
            text = json.dumps(entry, allow_nan=False)
        except ValueError:
            raise OutputError(
                f"{self.name}: {name}: a box or pose has a number that is not finite, so the model's output is "
                'invalid: try `precision="fp32"` (`--precision fp32`)'
            ) from None
        member = text if key is None else f"{json.dumps(key)}: {text}"
        self.append((self._separator + member).encode())
        self._separator = ",\n"

    def close(self) -> None:
        """Completes the file and gives it its name. Raises OutputError; the partial file then keeps all entries."""
        if self._file.closed:
            return
        try:
            self.append(self._tail)
        finally:
            super().close()
        with output_errors(self.name):
            os.replace(self.path, self.name)


def read_frames(path: Path, form: str, kind: str, references: tuple[str, ...]) -> dict[str, Any]:
    """The contents of an `IncrementalJson` with "frames"; the partial file of a writer that was killed is read, too.

    form, references: the format that it must have, and the frames of reference that it may have. kind: of the file, for
    messages. Raises InputError.
    """
    missing = f'the file is missing (expected {kind}, "format": "{form}")'
    content = read_entries(path, missing=missing)
    actual_form = content.get("format") if isinstance(content, dict) else type(content).__name__
    if actual_form != form:
        raise InputError(f'{path}: is not {kind}: "format" must be "{form}", found {actual_form!r:.40}')
    reference = content.get("frame_of_reference")
    if reference not in references:
        expected = f"{', '.join(references[:-1])} or {references[-1]}"
        raise InputError(f'{path}: "frame_of_reference" must be {expected}, found {reference!r:.40}')
    if not isinstance(content.get("frames"), list):
        raise InputError(f'{path}: "frames" is missing or not a list (expected one object per frame)')
    return content


def stamp_to_json(stamp: FrameStamp) -> dict[str, Any]:
    """The first members of an entry of "frames"."""
    return {"frame": stamp.index, "scene": stamp.scene, "timestamp_ns": stamp.timestamp_ns}


def stamp_from_json(entry: Any, location: str) -> FrameStamp:
    """The stamp of an entry of "frames", as `stamp_to_json` makes it. Raises InputError that begins with `location`."""
    stated = typed(entry, _Stamp, location)
    return FrameStamp(stated.frame, stated.scene, stated.timestamp_ns)


class _Stamp(Struct):
    frame: int
    timestamp_ns: int
    scene: str = ""
