"""Folders on this machine and in object stores, with the same operations.

An object store is named by a URL, such as s3://bucket/fleet. fsspec and its package for the protocol read it.
"""

import contextlib
import glob
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from bevcli.errors import BevcliError, InputError, OutputError
from bevcli.parsing.files import read_bytes
from bevcli.printing import reason_of
from bevcli.writing import output_errors, remove_parts, write_whole

_URL = re.compile(r"(?P<protocol>[a-z][a-z0-9+.-]+)://", re.IGNORECASE)
# The packages that fsspec needs for a protocol.
_PACKAGES = {"s3": "s3fs", "s3a": "s3fs", "gs": "gcsfs", "gcs": "gcsfs", "abfs": "adlfs", "az": "adlfs"}
RESULTS, FAILED, ATTEMPTS = "drives", "failed", ".bevcli/attempts"  # folders of a batch
RECORD = "drive.json"  # in the folder of a drive's results: its record. A folder with it is whole.
READING_THREADS = 16  # small files of a batch
FETCHING_THREADS = 16  # copying small files from an object store is waiting
LARGEST_RECORD = 1 << 28  # bytes of a small file that is read as a whole


class StoredFile(NamedTuple):
    """A file below a folder."""

    name: str  # path relative to the folder, with "/"
    size: int  # bytes
    version: str  # modification time or the store's checksum, which change with the contents


def is_url(text: str) -> bool:
    """A text names a folder in an object store. file:// is a local path."""
    return bool(_URL.match(text)) and not text.startswith("file://")


def expand(pattern: str) -> list[str]:
    """The paths or URLs of a glob pattern, sorted; of anything else, the text itself. Raises InputError."""
    if not glob.has_magic(pattern) or (not is_url(pattern) and os.path.exists(pattern)):
        return [pattern]
    if is_url(pattern):
        system, path = _filesystem(pattern)
        with _one_line(pattern, InputError):
            matches = sorted(system.unstrip_protocol(match) for match in system.glob(path.rstrip("/")))
    else:
        matches = sorted(glob.glob(pattern))
    if not matches:
        raise InputError(f"{pattern}: nothing matches this pattern (expected drives)")
    return matches


class LocalFolder:
    """A folder on this machine. Names are relative paths with "/".

    Attributes:
        path: the folder.
        where: the path or URL, for messages.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.where = path, str(path)

    def files(self) -> list[StoredFile]:
        """All files below the folder, sorted by name; of a file, the file itself. Raises InputError."""
        if self.path.is_file():
            return [_stored(self.path, self.path.name)]
        files = []
        for folder, _, names in os.walk(self.path):
            for name in names:
                path = Path(folder, name)
                with contextlib.suppress(OSError):  # a broken link
                    files.append(_stored(path, path.relative_to(self.path).as_posix()))
        return sorted(files)

    def names(self, folder: str) -> set[str]:
        """The entries of a subfolder, empty without it. Raises InputError."""
        try:
            return set(os.listdir(self.path / folder))
        except (FileNotFoundError, NotADirectoryError):
            return set()
        except OSError as error:
            raise InputError(f"{self.path / folder}: cannot be read ({error.strerror})") from None

    def read(self, name: str) -> bytes | None:
        """The contents of a small file, None if it is missing. Raises InputError."""
        path = self.path / name
        return read_bytes(path, LARGEST_RECORD) if path.is_file() else None

    @contextlib.contextmanager
    def copied(self, name: str) -> Iterator[Path]:
        """A file on this machine; of an object store, a temporary copy. Raises InputError where it is missing."""
        yield self.path / name

    def write(self, name: str, content: bytes) -> None:
        """Write a file. Readers see the old or the new contents. Raises OutputError."""
        write_whole(self.path / name, content, parents=True)

    def remove(self, name: str) -> None:
        """Remove a file or a subfolder, if it is there. Raises OutputError."""
        with output_errors(self.path / name, "removed"), contextlib.suppress(FileNotFoundError):
            remove_parts(self.path, [name])

    def land(self, folder: Path, name: str, last: str) -> None:
        """Move a local folder to a name on the same file system, in place of a damaged one. Raises OutputError.

        last: the file of the folder that says that it is whole; it never exists without the others.
        """
        with output_errors(self.path / name):
            (self.path / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.rmtree(self.path / name, ignore_errors=True)
            os.rename(folder, self.path / name)


class RemoteFolder:
    """A folder in an object store, with the methods of `LocalFolder`. Raises BevcliError where a package is missing."""

    def __init__(self, url: str) -> None:
        self.where = url.rstrip("/")
        self._system, path = _filesystem(self.where)
        self._root = str(path).rstrip("/")

    def files(self) -> list[StoredFile]:
        with _one_line(self.where, InputError):
            self._system.invalidate_cache()
            entries = self._system.find(self._root, detail=True)
        own_name = PurePosixPath(self._root).name  # where the folder is a file
        return sorted(_described(name[len(self._root) + 1 :] or own_name, entry) for name, entry in entries.items())

    def names(self, folder: str) -> set[str]:
        with _one_line(f"{self.where}/{folder}", InputError), contextlib.suppress(FileNotFoundError):
            self._system.invalidate_cache()
            return {PurePosixPath(name).name for name in self._system.ls(self._path(folder), detail=False)}
        return set()

    def read(self, name: str) -> bytes | None:
        with _one_line(f"{self.where}/{name}", InputError), contextlib.suppress(FileNotFoundError):
            return bytes(self._system.cat_file(self._path(name)))
        return None

    @contextlib.contextmanager
    def copied(self, name: str) -> Iterator[Path]:
        content = self.read(name)
        if content is None:
            raise InputError(f"{self.where}/{name}: is missing")
        with tempfile.TemporaryDirectory(prefix="bevcli-") as folder:
            path = Path(folder, Path(name).name)
            path.write_bytes(content)
            yield path

    def write(self, name: str, content: bytes) -> None:
        with _one_line(f"{self.where}/{name}", OutputError):
            self._system.pipe_file(self._path(name), content)

    def remove(self, name: str) -> None:
        with _one_line(f"{self.where}/{name}", OutputError), contextlib.suppress(FileNotFoundError):
            self._system.rm(self._path(name), recursive=True)

    def land(self, folder: Path, name: str, last: str) -> None:
        """As of a `LocalFolder`. An object store cannot rename a folder: the file `last` is uploaded last."""
        files = [path for path in folder.rglob("*") if path.is_file()]
        files.sort(key=lambda path: path == folder / last)
        with _one_line(f"{self.where}/{name}", OutputError):
            for path in files:
                self._system.put_file(str(path), self._path(f"{name}/{path.relative_to(folder).as_posix()}"))
        shutil.rmtree(folder)

    def fetch(self, local: Path, names: Sequence[str] | None = None) -> None:
        """Copy the folder, or the file that it is. names: only those of these files that exist. Raises InputError."""
        with _one_line(self.where, InputError), ThreadPoolExecutor(FETCHING_THREADS) as pool:
            if names is None and self._system.isfile(self._root):
                local.parent.mkdir(parents=True, exist_ok=True)
                self._system.get_file(self._root, str(local))
                return
            fetched = [file.name for file in self.files()] if names is None else names
            list(pool.map(lambda name: self._fetch_file(name, local, may_be_missing=names is not None), fetched))

    def _fetch_file(self, name: str, local: Path, *, may_be_missing: bool) -> None:
        inside = PurePosixPath(name)
        if ".." in inside.parts or inside.is_absolute():
            raise InputError(f"{self.where}: {inside}: leads out of the folder")
        (local / inside).parent.mkdir(parents=True, exist_ok=True)
        try:
            self._system.get_file(self._path(name), str(local / inside))
        except FileNotFoundError:
            (local / inside).unlink(missing_ok=True)  # some file systems make it first
            if not may_be_missing:
                raise

    def _path(self, name: str) -> str:
        return f"{self._root}/{name}"


Storage = LocalFolder | RemoteFolder


def open_storage(address: str) -> Storage:
    """The folder of a path or URL. Raises BevcliError where a package for the protocol is not installed."""
    return RemoteFolder(address) if is_url(address) else LocalFolder(Path(address.removeprefix("file://")))


def _stored(path: Path, name: str) -> StoredFile:
    status = path.stat()
    return StoredFile(name, status.st_size, str(status.st_mtime_ns))


def _described(name: str, entry: dict[str, Any]) -> StoredFile:
    keys = ("ETag", "etag", "md5Hash", "content_md5", "LastModified", "mtime", "updated", "last_modified")
    version = next((str(entry[key]) for key in keys if entry.get(key)), "")
    return StoredFile(name, int(entry.get("size") or 0), version)


def _filesystem(url: str) -> tuple[Any, str]:
    """fsspec's file system of a URL, and the path in it. Raises BevcliError."""
    match = _URL.match(url)
    assert match is not None
    protocol = match["protocol"].lower()
    import fsspec  # PyTorch brings it

    try:
        with _one_line(url, InputError):
            system, path = fsspec.core.url_to_fs(url)
    except ImportError as error:
        package = _PACKAGES.get(protocol)
        advice = f"run pip install {package}" if package else reason_of(error)[:200]
        raise BevcliError(f"{url}: {protocol}:// needs a package that is not installed: {advice}") from None
    return system, str(path)


@contextlib.contextmanager
def _one_line(url: str, error_type: type[BevcliError]) -> Iterator[None]:
    """Make one error of one line of what the packages of object stores raise, which have errors of many types."""
    try:
        yield
    except FileNotFoundError:
        raise error_type(f"{url}: is missing") from None
    except (BevcliError, ImportError):
        raise
    except Exception as error:
        raise error_type(f"{url}: the storage cannot be used ({reason_of(error):.200})") from None
