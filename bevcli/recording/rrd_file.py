"""RrdFile: the file of a recording, written by a thread of ours.

rerun's own writer waits for ever when the disk is full. So rerun writes into a pipe, which never fails, and a thread
moves the bytes into the file.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
from pathlib import Path

import rerun as rr

from bevcli.errors import OutputError

BLOCK = 1 << 20  # bytes
HEADER = 12  # bytes at the beginning of an .rrd file
TIMEOUT_S = 20.0


class RrdFile:
    """Receives the bytes of one recording stream.

        file = RrdFile(path)
        stream.set_sinks(file.sink())

    Attributes:
        path: the .rrd file.
        size: bytes in the file at the last `sync`; all frames up to then are readable.
    """

    def __init__(self, path: Path, resume_at: int | None = None) -> None:
        """Creates the file, or cuts an earlier one to `resume_at` bytes and goes on from there.

        resume_at: the `size` of an earlier RrdFile of the same recording.
        Raises OutputError if the file cannot be written.
        """
        self.path = path
        self.size = 0
        self._resumed = resume_at is not None
        self._error: OSError | None = None
        try:
            self._file = path.open("wb" if resume_at is None else "r+b", buffering=0)
            if resume_at is not None:
                self._file.truncate(resume_at)
                self.size = self._file.seek(resume_at)
        except OSError as error:
            raise OutputError(f"{path}: the recording cannot be written ({error.strerror})") from None
        self._to_skip = HEADER if self._resumed else 0  # the file has its header already
        self._pipe, self._pipe_in = os.pipe()
        os.set_blocking(self._pipe, False)
        self._busy = threading.Lock()
        self._thread = threading.Thread(target=self._move_all, name="rrd-file", daemon=True)
        self._thread.start()

    def sink(self) -> rr.FileSink:
        """Where rerun writes to. After it was passed to `set_sinks`, call `opened`."""
        return rr.FileSink(f"/dev/fd/{self._pipe_in}")

    def opened(self) -> None:
        """Says that rerun has opened the sink: the file ends when rerun closes it."""
        os.close(self._pipe_in)

    def sync(self) -> None:
        """Waits until all that rerun has flushed is in the file. Raises OutputError if it could not be written."""
        deadline = time.monotonic() + TIMEOUT_S
        while self._error is None and self._thread.is_alive():
            with self._busy:
                if not select.select([self._pipe], [], [], 0)[0]:
                    break
            if time.monotonic() > deadline:
                raise OutputError(f"{self.path}: the disk has not taken the recording for {TIMEOUT_S:.0f} s")
            time.sleep(0.0005)
        self._raise_error()
        self.size = self._file.tell()

    def close(self) -> None:
        """Waits until rerun has closed the sink, and closes the file. Raises OutputError as `sync` does."""
        self._thread.join(TIMEOUT_S)
        if self._thread.is_alive():
            raise OutputError(f"{self.path}: the disk has not taken the recording for {TIMEOUT_S:.0f} s")
        with self._file:
            if self._error is not None or self._resumed:
                # A cut message; or an index that counts the bytes from where the file was resumed.
                with contextlib.suppress(OSError):
                    self._file.truncate(self.size)
        self._raise_error()

    def is_deleted(self) -> bool:
        """Whether somebody has deleted the file that is being written."""
        return os.fstat(self._file.fileno()).st_nlink == 0

    def _raise_error(self) -> None:
        if self._error is not None:
            raise OutputError(f"{self.path}: the recording cannot be written ({self._error.strerror})")

    def _move_all(self) -> None:
        try:
            while True:
                select.select([self._pipe], [], [])
                with self._busy:
                    block = os.read(self._pipe, BLOCK)
                    if not block:
                        return
                    self._write(block)
        finally:
            os.close(self._pipe)

    def _write(self, block: bytes) -> None:
        """Writes a block. After an error the rest is read and thrown away, so that rerun never waits."""
        rest = memoryview(block)[self._to_skip :]
        self._to_skip -= len(block) - len(rest)
        try:
            while rest and self._error is None:
                rest = rest[os.write(self._file.fileno(), rest) :]
        except OSError as error:
            self._error = error
