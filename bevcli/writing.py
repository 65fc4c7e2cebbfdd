"""Writing of files under another name first, so that an interrupted command leaves no partial file.

And the folders of a user, as the XDG base directory specification has them.
"""

import os
import platform
import shutil
import sys
import uuid
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from bevcli.errors import OutputError

PARTIAL = ".partial"  # ends the name of a file while it is written
UNFINISHED = ".unfinished-"  # begins it; then machine and process
NO_HOME = Path("/nonexistent")  # as in the passwd of Debian; caches that cannot be written are done without


@contextmanager
def output_errors(path: Path, what: str = "written") -> Iterator[None]:
    """Every OSError of the block becomes an OutputError: PATH cannot be written."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path}: cannot be {what} ({error.strerror or error})") from None


def lock(descriptor: int) -> bool:
    """Lock an open file or folder until it is closed. False where another process has locked it.

    True without a lock where the system, or the file system, has none.
    """
    if sys.platform == "win32":
        return True
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass
    return True


@contextmanager
def whole_file(path: Path, *, parents: bool = False, regular: bool = False) -> Iterator[Path]:
    """A path to write to, in the folder of `path`.

        with whole_file(out) as unfinished:
            unfinished.write_text(text, encoding="utf-8")

    At the end of the block the file takes the place of `path`, also of a link. After an error it is deleted, and `path`
    stays as it was. Several processes may write the file at the same time: the last one wins. What killed processes
    left is deleted. A device or a pipe, and what is in /dev, is written directly.

    parents: make the folders that are missing; after an error they are deleted. regular: the file takes the place of a
    pipe too: a pipe that somebody has put there would be waited for.
    Raises OutputError where the file cannot be written; every OSError of the block counts as this. Errors of the block
    name `path`.
    """
    machine = f"{UNFINISHED}{zlib.crc32(platform.node().encode()):08x}-"
    made = [folder for folder in path.parents if parents and not folder.exists()]
    unfinished = path.with_name(f"{machine}{os.getpid()}-{uuid.uuid4().hex[:8]}{path.suffix}")
    try:
        with output_errors(path):
            if not regular and (path.is_relative_to("/dev") or (path.exists() and not path.is_file())):
                yield path
                return
            if parents:
                path.parent.mkdir(parents=True, exist_ok=True)
            _remove_abandoned_once(path.parent, machine)
            unfinished.touch(exist_ok=False)
            mode = unfinished.stat().st_mode & 0o777  # that the umask gives to new files
            unfinished.unlink()
            yield unfinished
            unfinished.chmod(mode)  # some libraries, such as safetensors, write files that only their owner can read
            os.replace(unfinished, path)
    except OutputError as error:
        raise OutputError(str(error).replace(str(unfinished), str(path))) from error
    finally:
        for left in (unfinished, partial_path(unfinished)):
            with suppress(OSError):
                left.unlink()
        for folder in made:
            with suppress(OSError):  # it holds the file, or another one
                folder.rmdir()


def write_whole(path: Path, content: bytes, **how: bool) -> None:
    """Write a file, so that readers see the old or the new contents. how: of `whole_file`."""
    with whole_file(path, **how) as unfinished:
        unfinished.write_bytes(content)


def remove_abandoned(folder: Path, prefix: str) -> None:
    """Delete what ended processes left in a folder: a name is the prefix, the number of the process, perhaps "-…"."""
    for path in folder.glob(f"{prefix}*") if sys.platform != "win32" else ():  # there, os.kill would end a process
        with suppress(ValueError, OverflowError, OSError):
            try:
                os.kill(int(path.name.removeprefix(prefix).partition("-")[0]), 0)
            except ProcessLookupError:
                remove_parts(folder, [path.name])


_remove_abandoned_once = cache(remove_abandoned)  # a folder may hold thousands of files


def remove_parts(folder: Path, parts: Iterable[str]) -> None:
    """Delete files and folders of these names in a folder; of a link, the link alone. Raises OSError."""
    for path in (folder / name for name in parts):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def check_output(path: Path, *inputs: Path) -> None:
    """Raises OutputError where a file to be written is one that the command reads."""
    if path.exists() and any(source.exists() and path.samefile(source) for source in inputs):
        raise OutputError(f"{path}: is the input (expected another file to write)")


def user_cache() -> Path:
    """The folder of all caches of bevcli, $XDG_CACHE_HOME/bevcli (default ~/.cache/bevcli)."""
    return user_folder("XDG_CACHE_HOME", ".cache")


def user_folder(variable: str, below_home: str) -> Path:
    """The folder of bevcli in that of an environment variable, by default in one below the user's home folder."""
    try:
        return Path(os.environ.get(variable) or Path.home() / below_home) / "bevcli"
    except RuntimeError:  # no HOME, and no entry in the system's list of users
        return NO_HOME / below_home / "bevcli"


def partial_path(path: Path) -> Path:
    """The name of a file while it is written."""
    return path.with_name(path.name + PARTIAL)


def weights_folder(folder: Path | None = None) -> Path:
    """The folder of downloaded weights: the chosen one, $BEVCLI_WEIGHTS_DIR, or ~/.cache/bevcli/weights."""
    named = os.environ.get("BEVCLI_WEIGHTS_DIR")
    return folder or (Path(named) if named else user_cache() / "weights")
