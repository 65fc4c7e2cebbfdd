"""RunFolder: the output folder of a run, locked against other runs, with a list of the files that runs wrote into it.

Its own files are in the subfolder .bevcli: `lock`, `written` (one path a line) and `state.pt` (for `resume`).
"""

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from bevcli.errors import OutputError
from bevcli.parsing.files import MIB, read_bytes
from bevcli.sequences.files.incremental_json import GrowingFile
from bevcli.writing import lock, output_errors, partial_path

OWN = ".bevcli"
SUMMARY = "summary.json"
LARGEST_LIST = 64 * MIB  # of the list of written files


class RunFolder(contextlib.ExitStack):
    """`with RunFolder(out, force=…, resume=…) as folder:`; the folder is made if it is missing.

    Attributes:
        path: the folder.
        state_path: where the state of the run is saved.
    """

    def __init__(self, path: Path, *, force: bool = False, resume: bool = False) -> None:
        super().__init__()
        self.path, self.state_path = path, path / OWN / "state.pt"
        self._force, self._resume = force, resume
        self._written: GrowingFile | None = None
        self._names: set[str] = set()
        self._is_new, self._is_discarded = not path.exists(), False

    def __enter__(self) -> "RunFolder":
        """Raises OutputError: another run uses the folder, or it holds something already, or it cannot be written."""
        out = self.path
        if out.exists() and not out.is_dir():
            raise OutputError(f"{out}: is a file (expected a folder to write to)")
        written = out / OWN / "written"
        with contextlib.ExitStack() as stack, output_errors(out):  # unlocks the folder if this fails
            is_free = self._force or self._resume or not out.exists()
            if not is_free and (written.exists() or any(entry.name != OWN for entry in out.iterdir())):
                raise OutputError(
                    f"{out}: exists already; pass `force=True` (`--force`) to overwrite it, `resume=True` (`--resume`) "
                    "to go on with an interrupted run, or `out` (`--out DIR`) for another folder"
                )
            stack.callback(self._remove_folders)  # once the lock is gone
            stack.enter_context(folder_lock(out))
            if written.is_file():  # the files of earlier runs
                names = read_bytes(written, LARGEST_LIST, error=OutputError).decode(errors="replace").splitlines()
                # A path with ".." would leave the folder: no run of ours writes one.
                inside = (not Path(name).is_absolute() and ".." not in Path(name).parts for name in names)
                self._names = {name for name, is_inside in zip(names, inside, strict=True) if name and is_inside}
            self.push(stack.pop_all())
        return self

    def add(self, path: Path) -> None:
        """Put a file on the list before it is written, so that `force` may remove it later.

        Raises OutputError if the file exists and no run wrote it, leads out of the folder through a link, or the list
        cannot be written.
        """
        name = os.path.relpath(path, self.path)
        if path.is_symlink() or not self._holds(path):
            raise OutputError(f"{path}: is a link, or leads out of {self.path} through one: remove it")
        if name in self._names:
            return
        if path.exists():
            raise OutputError(f"{path}: exists already, and no run wrote it: move it, or pass `out` (`--out DIR`)")
        if self._written is None:
            file = self.path / OWN / "written"
            self._written = GrowingFile(file, file.stat().st_size if file.exists() else None)
            self.callback(self._written.close)
        self._written.append(f"{name}\n".encode())
        self._names.add(name)

    def has_files(self) -> bool:
        """Runs have written files."""
        return bool(self._names)

    def remove_written(self) -> None:
        """Remove the files that earlier runs wrote, and nothing else. Raises OutputError."""
        named = [path for name in self._names for path in (self.path / name, partial_path(self.path / name))]
        files = [path for path in named if self._holds(path)]
        for path in (*files, self.state_path, self.path / OWN / "written"):
            with output_errors(path, "removed"):
                if path.is_file() or path.is_symlink():
                    path.unlink()
        self._names = set()

    def discard(self) -> None:
        """Remove what this run wrote, and on exit the folder if this run made it. Raises OutputError."""
        if self._written is not None:
            self._written.close()
            self._written = None
        self.remove_written()
        self._is_discarded = True

    def _remove_folders(self) -> None:
        for folder in (self.path / OWN, self.path) if self._is_new and self._is_discarded else ():
            with contextlib.suppress(OSError):  # it holds something else
                folder.rmdir()

    def _holds(self, path: Path) -> bool:
        """The folder of a file is in this one after all links are followed."""
        return Path(os.path.realpath(path.parent)).is_relative_to(os.path.realpath(self.path))


@contextlib.contextmanager
def folder_lock(out: Path) -> Iterator[None]:
    """Lock a folder, made if it is missing, against other runs. Raises OutputError where it is locked already.

    The lock file names the process. Somebody may delete it; so the folder itself is locked too.
    """
    if (out / OWN).is_symlink():
        raise OutputError(f"{out / OWN}: is a link (expected a folder): remove it")
    with contextlib.ExitStack() as stack:
        with output_errors(out):
            (out / OWN).mkdir(parents=True, exist_ok=True)
            path, is_ours = out / OWN / "lock", False
            while not is_ours:  # else the run before has just ended and removed its lock file
                file = stack.enter_context(path.open("a+", encoding="utf-8", errors="replace"))
                if not lock(file.fileno()):
                    file.seek(0)
                    holder = file.read(500).strip() or "an unknown process"
                    raise OutputError(f"{out}: is in use by another run ({holder}): wait, or pass `out` (`--out DIR`)")
                with contextlib.suppress(FileNotFoundError):
                    is_ours = os.path.samestat(os.fstat(file.fileno()), path.stat())
            file.truncate(0)
            file.write(f"process {os.getpid()}: {' '.join(sys.argv)[:400]}\n")
            file.flush()
            stack.callback(_remove, file.name)
            if sys.platform != "win32":
                folder = os.open(out, os.O_RDONLY)
                stack.callback(os.close, folder)
                if not lock(folder):
                    raise OutputError(f"{out}: is in use by another run: wait, or pass `out` (`--out DIR`)")
        yield


def _remove(path: str) -> None:
    with contextlib.suppress(OSError):
        os.unlink(path)
