"""Recording: writes frames and predictions into an .rrd file, frame by frame."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import rerun as rr

from bevcli.errors import OutputError, WaitError
from bevcli.frame import Frame, Prediction
from bevcli.recording import entities, log_static
from bevcli.recording.blueprint import Layout, recording_blueprint
from bevcli.recording.frame_log import FileBoxes, FrameLog, FrameLogState
from bevcli.recording.log_static import Recorded, RecordedBoxes, RecordedDrive, RecordedModel
from bevcli.recording.options import RecordingOptions
from bevcli.sequences.files.incremental_json import GrowingFile

BLOCK = 1 << 20  # bytes
HEADER = 12  # bytes at the beginning of an .rrd file
TIMEOUT_S = 20.0
APPLICATION = "bevcli"
FLUSH_TIMEOUT_S = 20.0
ROWS_AT_ONCE = 16  # rerun's threads encode so many while ours makes the next ones, not all of a frame at its end
INDEXED_FRAMES = 200  # a longer recording has no index, see `RrdFile`


class RrdFile(GrowingFile):
    """Receives the bytes of a recording, which a thread of ours writes.

    rerun's own writer waits for ever when the disk is full. So rerun writes into a pipe, which never fails, and a
    thread moves the bytes into the file. rerun keeps the index of a stream in memory until the stream ends, about
    0.3 MB a frame. A long recording therefore consists of several streams, one after the other in one file without an
    index.

        file = RrdFile(path)
        with file.sink() as sink:
            stream.set_sinks(sink)

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

    @contextlib.contextmanager
    def sink(self) -> Iterator[rr.FileSink]:
        """`with` the sink that rerun is to open in the block and writes to from then on; it ends when rerun closes it.

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
        try:
            yield rr.FileSink(f"/dev/fd/{self._pipe_in}")
        finally:
            os.close(self._pipe_in)

    def sync(self) -> None:
        """Waits until all that rerun has flushed is in the file.

        Raises OutputError if it could not be written, and WaitError if the disk does not answer.
        """
        deadline = time.monotonic() + TIMEOUT_S
        while self._error is None and self._thread.is_alive():
            if not self._busy.acquire(timeout=TIMEOUT_S):
                raise self._no_answer()
            try:
                if not select.select([self._pipe], [], [], 0)[0]:
                    break
            finally:
                self._busy.release()
            if time.monotonic() > deadline:
                raise self._no_answer()
            time.sleep(0.0005)
        if self._error is not None:
            raise self._error
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
        if self._error is not None:
            raise self._error

    def _no_answer(self) -> WaitError:
        return WaitError(f"{self.path}: the disk has not taken the recording for {TIMEOUT_S:.0f} s")

    def _move_all(self, pipe: int) -> None:
        """Moves a stream into the file, until rerun closes it."""
        try:
            while True:
                select.select([pipe], [], [])  # as long as rerun has nothing to write
                with self._busy:
                    size = os.readv(pipe, [self._block])
                    if not size:
                        return
                    if pipe != self._pipe:
                        continue
                    rest = self._block[self._to_skip : size]
                    self._to_skip -= size - len(rest)
                    # After an error the rest is read and thrown away, so that rerun never waits.
                    try:
                        if self._error is None:
                            self.append(rest)
                    except OutputError as error:
                        self._error = error
        finally:
            os.close(pipe)


class LiveSink(Protocol):
    """A viewer that follows a recording while it is written, such as `bevcli.viewer.web.LiveView`."""

    def open(self, recording: Path) -> None:
        """Called once, when the file is there."""

    def close(self) -> None:
        """Called once, when the file is whole."""


@dataclass(frozen=True)
class RecordingState:
    """The state of a recording after a frame, from which a later one goes on.

    Attributes:
        recording_id: rerun's id of the recording.
        size: bytes of the file that are kept.
        frames: what the frames so far leave behind.
    """

    recording_id: str
    size: int
    frames: FrameLogState


class Recording:
    """Writes a recording: `with Recording(...) as recording: recording.log(frame, prediction)`, frames in order.

    Each frame is on the disk when `log` returns, so a killed run keeps all frames up to then.

    Args:
        path: the .rrd file to write; an existing one is replaced.
        sequence: the drive, or a `Session`; the rig and the name are taken from it.
        model: the class names, the name and whether it is trained are taken from it; `RecordedBoxes` without a model.
        options: how much is written; the defaults of RecordingOptions if None.
        live: a viewer that follows the recording; None for no viewer.
        resume: `state()` of the recording that was interrupted; the file is cut to its size and goes on from there.

    Raises OutputError when the file cannot be written, and InputError when a mesh cannot be read.
    """

    def __init__(
        self,
        path: str | Path,
        sequence: RecordedDrive,
        model: RecordedModel | RecordedBoxes,
        options: RecordingOptions | None = None,
        live: LiveSink | None = None,
        resume: RecordingState | None = None,
    ) -> None:
        self.path, self._live = Path(path), live
        self._recorded = Recorded(sequence, model, RecordingOptions() if options is None else options)
        self._recording_id = str(uuid.uuid4()) if resume is None else resume.recording_id
        self._size = None if resume is None else resume.size
        # rerun keeps two threads and some MB of every stream that nobody uses any more, until this call. It may wait
        # for a sink that hangs.
        threading.Thread(target=rr.bindings.flush_and_cleanup_orphaned_recordings, daemon=True).start()
        batches = rr.ChunkBatcherConfig(flush_num_rows=ROWS_AT_ONCE)
        self._stream = rr.RecordingStream(APPLICATION, recording_id=self._recording_id, batcher_config=batches)
        self._frames = 0
        frames = None if resume is None else resume.frames
        self._frame_log = FrameLog(self._stream, self._recorded, frames)

    def __enter__(self) -> Recording:
        recorded, object_classes = self._recorded, self._recorded.object_classes
        vehicle, of_classes = None, {}
        path = recorded.options.vehicle_mesh
        if path is not None or any(settings.mesh for settings in object_classes.values()):
            from bevcli.recording import meshes

            vehicle = None if path is None else meshes.load_vehicle(path)
            of_classes = meshes.read_class_meshes(object_classes)
        self._layout = recording_blueprint(recorded)
        self.file = RrdFile(self.path, self._size)
        self._connect(recording_blueprint(recorded, follows=self._live is not None))
        if self._live is not None:
            self._live.open(self.path)
        log_static.log_scene(self._stream, recorded.drive.rig, recorded.classes, vehicle, recorded.grid)
        for name, mesh in of_classes.items():
            log_static.log_mesh(self._stream, entities.class_mesh(name), mesh)
        log_static.log_about(self._stream, recorded)
        return self

    def _connect(self, layout: Layout | None) -> None:
        """Makes rerun write a new stream into the file. Raises OutputError."""
        try:
            with self.file.sink() as sink:
                self._stream.set_sinks(sink, default_blueprint=layout)
        except RuntimeError as error:
            raise OutputError(f"{self.path}: the recording cannot be written ({error})") from error
        finally:
            if layout is not None:
                layout.free()

    def __exit__(self, *error: object) -> None:
        try:
            self._frame_log.finish()
            if self._live is not None:  # who opens the file later sees it from the first frame on
                self._stream.send_blueprint(self._layout, make_active=False)
                self._layout.free()
            self._flush()
        finally:
            self.file.leave_out_index()
            # rerun itself waits without a limit.
            closing = threading.Thread(target=self._stream.disconnect, name="close-recording", daemon=True)
            closing.start()
            closing.join(FLUSH_TIMEOUT_S)
            if closing.is_alive():
                raise WaitError(f"{self.path}: the recording could not be closed within {FLUSH_TIMEOUT_S:.0f} s")
            self.file.close()
            if self._live is not None:
                self._live.close()

    def state(self) -> RecordingState | None:
        """The state from which a later Recording goes on; None as long as it cannot be resumed."""
        frames = self._frame_log.state()
        return None if frames is None else RecordingState(self._recording_id, self.file.synced, frames)

    def log(self, frame: Frame, found: Prediction | FileBoxes) -> None:
        """Writes one frame: images, shown boxes, ground truth, curves, events and the model's internals.

        found: by the model, or without one the boxes of each file, in the world frame; None where it lacks the frame.
        """
        self._frame_log.log(frame, found)
        self._flush()
        self._frames += 1
        if self._frames % INDEXED_FRAMES == 0:
            self._connect(None)  # a new stream frees the index of the one before

    def event(self, text: str, level: str = "INFO") -> None:
        """Writes a line into the event log, at the newest frame; before the first frame, at the first one.

        level: "INFO", "WARN" or "ERROR".
        """
        self._frame_log.event(text, level)

    def _flush(self) -> None:
        try:
            self._stream.flush(timeout_sec=FLUSH_TIMEOUT_S)
            self.file.sync()
        except (RuntimeError, ValueError, TimeoutError) as error:
            raise OutputError(f"{self.path}: the recording cannot be written ({error})") from error
