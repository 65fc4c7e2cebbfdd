"""GrowingFile: a file that only grows, by whole pieces."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from bevcli.errors import OutputError


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

    def append(self, content: bytes) -> None:
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
        """Whether somebody has deleted the file while it is written."""
        return os.fstat(self._file.fileno()).st_nlink == 0

    def _failure(self, error: OSError) -> OutputError:
        return OutputError(f"{self.name}: cannot be written ({error.strerror})")
