"""RunFolder: the output folder of a run, locked against other runs, with a list of the files that runs wrote into it.

Its own files are in the subfolder .bevcli: `lock`, `written` (one path a line) and `state.safetensors` (for --resume).
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import IO

from bevcli.errors import InputError, OutputError
from bevcli.parsing.documents import read_json
from bevcli.parsing.files import MIB, read_bytes
from bevcli.sequences.files.growing_file import GrowingFile
from bevcli.sequences.files.incremental_json import partial_path

OWN = ".bevcli"
SUMMARY = "summary.json"
LARGEST_LIST = 64 * MIB  # of the list of written files


class RunFolder:
    """`with RunFolder(out, force=…, resume=…) as folder:`; the folder is made if it is missing.

    Attributes:
        path: the folder.
        state_path: where the state of the run is saved.
    """

    def __init__(self, path: Path, *, force: bool = False, resume: bool = False) -> None:
        self.path, self.state_path = path, path / OWN / "state.safetensors"
        self._force, self._resume = force, resume
        self._lock: IO[str] | None = None
        self._written: GrowingFile | None = None
        self._names: set[str] = set()

    def __enter__(self) -> RunFolder:
        """Raises OutputError: another run uses the folder, or it holds something already, or it cannot be written."""
        out = self.path
        if out.exists() and not out.is_dir():
            raise OutputError(f"{out}: is a file (expected a folder to write to)")
        try:
            if out.exists() and not (self._force or self._resume or self._has_no_run()):
                raise OutputError(
                    f"{out}: exists already; pass --force to overwrite it, --resume to go on with an interrupted run, "
                    "or --out DIR for another folder"
                )
            (out / OWN).mkdir(parents=True, exist_ok=True)
            self._lock = _locked(out / OWN / "lock", out)
            self._names = set(self._read_written())
        except OSError as error:
            self._unlock()
            raise OutputError(f"{out}: cannot be written ({error.strerror})") from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._written is not None:
            self._written.close()
        self._unlock()

    def add(self, path: Path) -> None:
        """Puts a file on the list before it is written, so that --force may remove it later.

        Raises OutputError if the file exists and no run wrote it, or the list cannot be written.
        """
        name = os.path.relpath(path, self.path)
        if name in self._names:
            return
        if path.exists():
            raise OutputError(f"{path}: exists already, and no run wrote it: move it, or pass --out DIR")
        if self._written is None:
            file = self.path / OWN / "written"
            self._written = GrowingFile(file, file.stat().st_size if file.exists() else None)
        self._written.append(f"{name}\n".encode())
        self._names.add(name)

    def has_files(self) -> bool:
        """Whether a run has written files."""
        return bool(self._names)

    def remove_written(self) -> None:
        """Removes the files that earlier runs wrote, and nothing else. Raises OutputError."""
        files = [path for name in self._names for path in (self.path / name, partial_path(self.path / name))]
        try:
            for path in (*files, self.state_path, self.path / OWN / "written"):
                if path.is_file() or path.is_symlink():
                    path.unlink()
        except OSError as error:
            raise OutputError(f"{path}: cannot be removed ({error.strerror})") from None
        self._names = set()

    def _has_no_run(self) -> bool:
        return all(entry.name == OWN for entry in self.path.iterdir()) and not (self.path / OWN / "written").exists()

    def _read_written(self) -> Iterator[str]:
        """The files of earlier runs: the list, or of older versions the files that summary.json names."""
        file = self.path / OWN / "written"
        if file.is_file():
            content = read_bytes(file, LARGEST_LIST, error=OutputError)
            names = content.decode(errors="replace").splitlines()
        else:
            names = [os.path.relpath(path, self.path) for path in _files_in_summary(self.path / SUMMARY)]
        # A path with ".." would leave the folder: no run of ours writes one.
        yield from (name for name in names if name and not Path(name).is_absolute() and ".." not in Path(name).parts)

    def _unlock(self) -> None:
        if self._lock is not None:
            _release(self._lock)
            self._lock = None


@contextlib.contextmanager
def folder_lock(out: Path) -> Iterator[None]:
    """Locks a folder, made if it is missing, against other runs. Raises OutputError where it is locked already."""
    try:
        (out / OWN).mkdir(parents=True, exist_ok=True)
        lock = _locked(out / OWN / "lock", out)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror})") from None
    try:
        yield
    finally:
        _release(lock)


def _release(lock: IO[str]) -> None:
    with contextlib.suppress(OSError):
        os.unlink(lock.name)
    lock.close()


def _locked(path: Path, out: Path) -> IO[str]:
    """The open lock file, which holds the number and the command of this process. Raises OutputError."""
    if sys.platform == "win32":
        return path.open("w")
    import fcntl

    while True:
        file = path.open("a+", errors="replace")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read(500).strip() or "an unknown process"
            file.close()
            raise OutputError(f"{out}: is in use by another run ({holder}): wait, or pass --out DIR") from None
        except OSError:  # a file system without locks
            return file
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                break
        file.close()  # the run before has just ended and removed its lock file
    file.truncate(0)
    file.write(f"process {os.getpid()}: {' '.join(sys.argv)[:400]}\n")
    file.flush()
    return file


def _files_in_summary(path: Path) -> list[str]:
    try:
        summary = read_json(path)
    except InputError:
        return []
    if not isinstance(summary, dict) or "bevcli_version" not in summary or not isinstance(summary.get("files"), list):
        return []
    return [file for file in summary["files"] if isinstance(file, str)]
