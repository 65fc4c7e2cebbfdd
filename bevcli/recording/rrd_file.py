"""RrdFile: the file of a recording, written by a thread of ours.

rerun's own writer waits for ever when the disk is full. So rerun writes into a pipe, which never fails, and a thread
moves the bytes into the file.

rerun keeps the index of a stream in memory until the stream ends, about 0.3 MB a frame. A long recording therefore
consists of several streams, one after the other in one file without an index.
"""

import contextlib
import os
import select
import threading
import time
from pathlib import Path

import rerun as rr

from bevcli.errors import OutputError, WaitError
from bevcli.sequences.files.incremental_json import GrowingFile

BLOCK = 1 << 20  # bytes
HEADER = 12  # bytes at the beginning of an .rrd file
TIMEOUT_S = 20.0


class RrdFile(GrowingFile):
    """Receives the bytes of a recording.

        file = RrdFile(path)
        stream.set_sinks(file.sink())
        file.opened()

    Attributes:
        synced: bytes in the file at the last `sync`; all frames up to then are readable.
    """

    def __init__(self, path: Path, resume_at: int | None = None) -> None:
        """As a GrowingFile. resume_at: `synced` of an earlier RrdFile of the same recording."""
        super().__init__(path, resume_at)
        self.synced = self.size
        self._is_joined = resume_at is not None  # of several streams, so that the index of the last does not fit
        self._error: OutputError | None = None
        self._pipe = -1
        self._busy = threading.Lock()
        self._block = memoryview(bytearray(BLOCK))  # allocated here, where a lack of memory can be told

    def sink(self) -> rr.FileSink:
        """The sink that rerun writes to from now on. After it was passed to `set_sinks`, call `opened`.

        Call `sync` before the second one: all that comes through an earlier sink afterwards, its index, is left out.
        """
        pipe, self._pipe_in = os.pipe()
        os.set_blocking(pipe, False)
        with self._busy:
            self._is_joined |= self._pipe >= 0
            self._to_skip = HEADER if self.size else 0  # the file has its header already
            self._pipe = pipe
        self._thread = threading.Thread(target=self._move_all, args=(pipe,), name="rrd-file", daemon=True)
        self._thread.start()
        return rr.FileSink(f"/dev/fd/{self._pipe_in}")

    def opened(self) -> None:
        """Says that rerun has opened the sink: the file ends when rerun closes it."""
        os.close(self._pipe_in)

    def sync(self) -> None:
        """Waits until all that rerun has flushed is in the file.

        Raises OutputError if it could not be written, and WaitError if the disk does not answer.
        """
        deadline = time.monotonic() + TIMEOUT_S
        while self._error is None and self._thread.is_alive() and not self._is_drained():
            if time.monotonic() > deadline:
                raise self._no_answer()
            time.sleep(0.0005)
        self._raise_error()
        self.synced = self.size

    def leave_out_index(self) -> None:
        """Call after the last `sync`, before rerun closes the sink: of several streams, the last has no index either.

        It would count the bytes from the start of its stream, and readers would not find the frames before.
        """
        with self._busy:
            if self._is_joined:
                self._pipe = -1

    def close(self) -> None:
        """Waits until rerun has closed the sink, and closes the file. Raises OutputError as `sync` does."""
        self._thread.join(TIMEOUT_S)
        if self._thread.is_alive():
            raise self._no_answer()
        with self._file:
            if self._error is not None or self._is_joined:  # there may be a cut message
                with contextlib.suppress(OSError):
                    self._file.truncate(self.synced)
        self._raise_error()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    def _no_answer(self) -> WaitError:
        return WaitError(f"{self.path}: the disk has not taken the recording for {TIMEOUT_S:.0f} s")

    def _is_drained(self) -> bool:
        """True if all that is in the pipe has been written."""
        if not self._busy.acquire(timeout=TIMEOUT_S):
            raise self._no_answer()
        try:
            return not select.select([self._pipe], [], [], 0)[0]
        finally:
            self._busy.release()

    def _move_all(self, pipe: int) -> None:
        """Moves a stream into the file, until rerun closes it."""
        try:
            while True:
                select.select([pipe], [], [])  # as long as rerun has nothing to write
                with self._busy:
                    size = os.readv(pipe, [self._block])
                    if not size:
                        return
                    if pipe == self._pipe:
                        self._write(self._block[:size])
        finally:
            os.close(pipe)

    def _write(self, block: memoryview) -> None:
        """Writes a block. After an error the rest is read and thrown away, so that rerun never waits."""
        rest = block[self._to_skip :]
        self._to_skip -= len(block) - len(rest)
        try:
            if self._error is None:
                self.append(rest)
        except OutputError as error:
            self._error = error
