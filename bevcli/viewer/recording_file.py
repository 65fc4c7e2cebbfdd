"""Opens the file of a recording. A recording that was cut off is repaired in a temporary copy."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Literal

import rerun as rr

from bevcli.errors import BevcliError, InputError
from bevcli.parsing.files import open_regular, plain_name, run_program, run_python
from bevcli.recording.entities import FILE_HEADER, INDEX, MESSAGE_HEADER, MESSAGE_KINDS
from bevcli.sequences.format import drives_in, is_drive
from bevcli.viewer.rerun_viewer import take_screenshot, viewer_binary, viewer_environment

if TYPE_CHECKING:
    from rerun.notebook import Viewer

# Reads all of a recording in a process of its own: damaged data ends rerun's process at once, without an exception.
CHECK = """
import sys, warnings
from rerun.chunk import RrdReader
limit_memory()
warnings.simplefilter("ignore")
try:
    reader = RrdReader(sys.argv[1])
    for chunk in reader.stream() if reader.recordings() else ():
        chunk.to_record_batch()
except Exception as error:
    sys.exit(" ".join(str(error).split()))
"""
CUT_SHORT = b"trailing bytes in rrd stream"  # logged by rerun, which raises no error here
CHECK_MEMORY = 1 << 30  # bytes, beside four times the file's size
# rerun's allocator sets aside 1 GiB at its start, which would count. In KiB.
CHECK_ENVIRONMENT = {"MIMALLOC_ARENA_RESERVE": "65536"}
SECONDS, BYTES_PER_SECOND = 30.0, 1e6  # time limit of a process that reads a recording
RECORDING = "recording.rrd"
PREDICTIONS = "predictions.json"
IMAGES = ("frames.csv", "images", "videos")  # of a sequence folder, which may hold predictions too
MAGIC_START = b"RRF"  # of all versions of rerun
MAGIC, FOOTER = b"RRF2", b"RRF2FOOT"  # the first bytes of an .rrd file, and the bytes 12 before its end
OLDEST = (0, 23)  # version of rerun whose files are read; the bytes after MAGIC state a file's


@contextmanager
def open_recording(path: Path) -> Iterator[Path]:
    """The file of a recording. If its last message is cut: a repaired copy, which is deleted when the context ends.

    path: the recording, or the output folder of `bevcli run`.
    Raises InputError if the file is missing, is not a recording, was cut off before its first frame, or is damaged.
    """
    path = recording_in(path)
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: is not a regular file (expected no folder, pipe or device)")
    if _is_whole(path):
        with plain_name(path) as name:
            _check(Path(name), path)
            yield Path(name)
        return
    with tempfile.TemporaryDirectory(prefix="bevcli-") as folder:
        copy = Path(folder) / RECORDING
        _repair(path, copy)
        if not copy.is_file() or copy.stat().st_size < 1000:
            raise InputError(f"{path}: the recording was cut off before its first frame; nothing can be shown")
        _check(copy, path)
        try:
            yield copy
        except BevcliError as error:
            raise type(error)(str(error).replace(str(copy), str(path))) from None


def is_recording(path: Path) -> bool:
    """True for a recording, also one that is damaged or missing, and for the folder of a run that has one."""
    if path.is_dir():
        return (path / RECORDING).is_file()
    if path.suffix.lower() == ".rrd" or not path.is_file():
        return True
    with open_regular(path) as file:
        return file.read(len(MAGIC_START)) == MAGIC_START


def check_is_drive(path: Path) -> None:
    """Raise InputError for what is no recording and no drive, such as boxes alone."""
    is_run = (path / PREDICTIONS).is_file() and not any((path / name).exists() for name in IMAGES)
    if not is_run and (is_drive(path) or (path.is_dir() and drives_in(path))):
        return
    if is_run or (path.is_file() and _begins_like_json(path)):
        raise InputError(
            f"{path}: holds boxes (expected a recording or a drive): show them with the drive that they belong to: "
            f"`bevcli viz DRIVE --boxes {path}`"
        )
    recording_in(path)  # these raise InputError
    _is_whole(path)


def _begins_like_json(path: Path) -> bool:
    with open_regular(path) as file:
        return file.read(64).lstrip()[:1] in (b"{", b"[")


def recording_in(path: Path) -> Path:
    """The recording of a run's folder; any other path as it is. Raises InputError for a folder without a recording."""
    if not path.is_dir():
        return path
    recording = path / RECORDING
    if not recording.is_file():
        raise InputError(
            f"{path}: the folder has no {RECORDING} (expected a recording, a folder of `bevcli run`, or a drive)"
        )
    return recording


def _check(file: Path, path: Path) -> None:
    """Raises InputError, which names `path`, unless all of a file can be read."""
    memory = CHECK_MEMORY + 4 * file.stat().st_size
    with _limited(path) as (seconds, environment):
        done = run_python(CHECK, [file], memory, seconds, environment)
    if done.returncode == 0 and CUT_SHORT in done.stderr:
        raise InputError(f"{path}: the recording cannot be read: it is damaged (rerun does not read all of it)")
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines() if done.returncode == 1 else []
        reason = lines[-1].replace(str(file), path.name) if lines else "rerun ends when it reads it"
        raise InputError(f"{path}: the recording cannot be read: it is damaged ({reason:.200})")


def _repair(path: Path, copy: Path) -> None:
    """Copies all messages of a recording that can be read. Raises InputError if this takes too long."""
    command = [str(viewer_binary()), "rrd", "filter", "--continue-on-error", str(path), "-o", str(copy)]
    with _limited(path) as (seconds, environment):
        run_program(command, seconds, environment)


@contextmanager
def _limited(path: Path) -> Iterator[tuple[float, dict[str, str]]]:
    """The time limit and the environment of a process that reads a recording. Raises InputError after that time."""
    seconds = SECONDS + path.stat().st_size / BYTES_PER_SECOND
    try:
        yield seconds, {**viewer_environment(), **CHECK_ENVIRONMENT, "RUST_BACKTRACE": "0"}
    except subprocess.TimeoutExpired:
        raise InputError(f"{path}: the recording cannot be read within {seconds:.0f} s: it is damaged") from None


def _is_whole(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            start, version = file.read(len(MAGIC)), file.read(3)
            size = file.seek(0, 2)
            file.seek(max(0, size - 12))
            end = file.read(12)
            has_whole_messages = end.startswith(FOOTER) or _ends_with_a_message(file, size)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such recording (`bevcli run` writes one)") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if not start:
        raise InputError(f"{path}: is not a recording: the file is empty")
    if start in (b"RRF0", b"RRF1") or (start == MAGIC and tuple(version[:2]) < OLDEST):
        raise InputError(
            f"{path}: an old version of rerun wrote this recording, {'.'.join(map(str, version))} (expected "
            f"{'.'.join(map(str, OLDEST))} or newer): open it with that version of rerun, or record it anew"
        )
    if start != MAGIC:
        raise InputError(f"{path}: is not a recording (expected a file that starts with RRF2, found {start!r})")
    return has_whole_messages


def _ends_with_a_message(file: BinaryIO, size: int) -> bool:
    """True if a file without an index ends after a whole message and has one at least."""
    position = FILE_HEADER
    while position + MESSAGE_HEADER.size <= size:
        file.seek(position)
        kind, length = MESSAGE_HEADER.unpack(file.read(MESSAGE_HEADER.size))
        if kind == INDEX:
            return False
        if kind not in MESSAGE_KINDS:
            raise InputError(f"{file.name}: the recording cannot be read: it is damaged (a message of kind {kind})")
        position += MESSAGE_HEADER.size + length
    return position == size > FILE_HEADER


def show(
    recording: str | Path, *, width: int | Literal["auto"] = "auto", height: int | Literal["auto"] = 720
) -> Viewer:
    """rerun's viewer with a recording, as a widget for a Jupyter notebook: make it the last line of a cell.

        bevcli.show("street.rrd")

    Needs the extra `bevcli[notebook]`.

    Args:
        recording: a recording of `bevcli.Recording` or `bevcli run`.
        width: pixels, or "auto" for the width of the cell.
        height: pixels, or "auto" for 16:9.

    Raises:
        InputError: the file is missing or is not a recording.
        BevcliError: the notebook package of rerun is not installed.
    """
    from rerun.notebook import HAS_NOTEBOOK, Viewer  # needs IPython and costs a second

    if not HAS_NOTEBOOK:
        raise BevcliError("the notebook viewer is not installed: pip install 'bevcli[notebook]'")
    viewer = Viewer(width=width, height=height, use_global_recording=False, theme="dark")
    with open_recording(Path(recording)) as file:
        stream = rr.RecordingStream("bevcli")
        viewer.add_recording(stream)
        stream.log_file_from_path(file)
        stream.flush(timeout_sec=60.0)
    return viewer


def screenshot(recording: str | Path, image: str | Path, *, frame: int | None = None) -> tuple[str, ...]:
    """Write an image of the viewer with a recording; return the names of its views.

        bevcli.screenshot("street.rrd", "street.png", frame=3)

    Needs a Vulkan driver, but no screen and no GPU. `Prediction.plot` needs neither, and no recording.

    Args:
        recording: a recording, or the folder of a run.
        image: the .png, .jpg or .jpeg file to write.
        frame: index of the frame. Default: the first one.

    Raises:
        InputError: there is no such recording or frame, or the image has another ending.
        OutputError: the viewer cannot draw, or the file cannot be written.
    """
    with open_recording(Path(recording)) as file:
        return take_screenshot(file, Path(image), frame)
