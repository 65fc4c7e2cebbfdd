"""Writing of files under another name first, so that an interrupted command leaves no partial file."""

import os
import shutil
import sys
import uuid
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from bevcli.errors import OutputError


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
def whole_file(path: Path, *, parents: bool = False, shared: bool = False, regular: bool = False) -> Iterator[Path]:
    """A path to write to, in the folder of `path`.

        with whole_file(out) as unfinished:
            unfinished.write_text(text)

    At the end of the block the file takes the place of `path`, also of a link. After an error it is deleted, and `path`
    stays as it was. A device or a pipe, and what is in /dev, is written directly.

    parents: make the folders that are missing. shared: several processes may write the file at the same time. Else
    its unfinished name is always the same, so that killed processes leave one such file at most. regular: the file
    takes the place of a pipe too: a pipe that somebody has put there would be waited for.
    Raises OutputError where the file cannot be written; every OSError of the block counts as this.
    """
    mark = uuid.uuid4().hex[:8] if shared else f"{zlib.crc32(os.fsencode(path.name)):08x}"
    unfinished = path.with_name(f".unfinished-{mark}{path.suffix}")
    try:
        with output_errors(path):
            if not regular and (path.is_relative_to("/dev") or (path.exists() and not path.is_file())):
                yield path
                return
            if parents:
                path.parent.mkdir(parents=True, exist_ok=True)
            unfinished.unlink(missing_ok=True)  # it may be a link
            mode = _mode_of_new_files(unfinished)
            yield unfinished
            unfinished.chmod(mode)  # some libraries, such as safetensors, write files that only their owner can read
            os.replace(unfinished, path)
    finally:
        with suppress(OSError):
            unfinished.unlink()


def _mode_of_new_files(path: Path) -> int:
    """The mode that the umask gives to a file of this name, which does not exist before or after."""
    path.touch(exist_ok=False)
    mode = path.stat().st_mode & 0o777
    path.unlink()
    return mode


def write_whole(path: Path, content: bytes, **how: bool) -> None:
    """Write a file, so that readers see the old or the new contents. how: of `whole_file`."""
    with whole_file(path, **how) as unfinished:
        unfinished.write_bytes(content)


@contextmanager
def whole_folder(folder: Path, parts: Iterable[str]) -> Iterator[None]:
    """Make a folder, in which the block writes files and folders of these names; after an error they are deleted.

    So is the folder itself if it was missing before. Other files in it are kept.
    Raises OutputError where the folder cannot be made.
    """
    is_new = not folder.exists()
    with output_errors(folder, "created"):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        with suppress(OSError):
            remove_parts(folder, parts)
            if is_new:
                folder.rmdir()
        raise


def remove_parts(folder: Path, parts: Iterable[str]) -> None:
    """Delete files and folders of these names in a folder; of a link, the link alone. Raises OSError."""
    for path in (folder / name for name in parts):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def check_output(path: Path, *inputs: Path) -> None:
    """Raises OutputError where a file to be written is one that the command reads."""
    if path.exists() and any(each.exists() and path.samefile(each) for each in inputs):
        raise OutputError(f"{path}: is the input (expected another file to write)")
