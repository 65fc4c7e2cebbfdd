"""Reads whole files within limits of size; other programs read within limits of time and memory.

Pipes, devices and sockets are refused: they may not end.
"""

import hashlib
import json
import os
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path

from bevcli.errors import BevcliError, InputError, WeightsError
from bevcli.printing import valid_text

MIB = 1 << 20
VIDEO_SUFFIXES = (".mp4", ".mkv", ".avi", ".webm", ".mov", ".m4v", ".ts", ".mts", ".m2ts")
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
# RLIMIT_DATA, and not the address space: allocators reserve more than they use.
LIMIT_MEMORY = """
def limit_memory():
    try:
        import resource
        most = {memory}
        try:
            with open("/proc/self/statm") as file:  # what imports take varies with the processor
                most += int(file.read().split()[5]) * resource.getpagesize()
        except OSError:  # no Linux
            pass
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    except (ImportError, ValueError, OSError):
        pass
"""


def is_there(path: Path) -> bool:
    """True if a file that may be missing is there. It may be a pipe or a broken link, which is an error when read."""
    return os.path.lexists(path)


def is_file_name(name: str) -> bool:
    """True for a name from outside, of a camera, a scene or a server, that may become that of a file or folder."""
    return 0 < len(name) <= 100 and name.isprintable() and not set(name) & {"/", "\\"} and name.strip(". ") != ""


def read_bytes(
    path: Path, largest: int, *, missing: str = "the file is missing", error: type[BevcliError] = InputError
) -> bytes:
    """The contents of a regular file of at most `largest` bytes.

    missing: text of the message for a file that is not there.
    error: kind of exception for a file that is missing, larger, no regular file, or cannot be read.
    """
    with open_regular(path, missing=missing, error=error) as file:
        size = os.fstat(file.fileno()).st_size
        if size > largest:
            raise error(f"{path}: the file has {_size(size)} (expected at most {_size(largest)})")
        try:
            return file.read(size)
        except OSError as failure:
            raise error(f"{path}: cannot be read ({failure.strerror})") from None


def read_text(path: Path, largest: int, *, error: type[BevcliError] = InputError) -> str:
    """The contents of a UTF-8 file, see `read_bytes`."""
    try:
        return read_bytes(path, largest, error=error).decode()
    except UnicodeDecodeError as failure:
        raise error(f"{path}: cannot be read as text ({failure})") from None


def open_regular(
    path: Path, *, missing: str = "the file is missing", error: type[BevcliError] = InputError
) -> BufferedReader:
    """Opens a regular file for reading. Raises `error` for anything else; opening a pipe does not wait for a writer."""
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except FileNotFoundError:
        raise error(f"{path}: {missing}") from None
    except OSError as failure:
        raise error(f"{path}: cannot be read ({failure.strerror})") from None
    except ValueError:  # a null byte in the name
        raise error(f"{str(path)!r}: is not a file name") from None
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise error(f"{path}: is not a regular file (expected no folder, pipe or device)")
    return os.fdopen(descriptor, "rb")


def hash_of_file(path: Path) -> str:
    """SHA-256 of the contents of a file of weights, hexadecimal. Raises WeightsError where it is no regular file."""
    with open_regular(path, error=WeightsError) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_of_values(values: object) -> str:
    """SHA-256, hexadecimal, of what a result depends on: values that JSON takes; the order of keys does not count."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


@contextmanager
def plain_name(path: Path) -> Iterator[str]:
    """A name for libraries that take UTF-8 only (OpenCV ends the process at others): of a link, where it has to be.

    The library opens the file, which may be a new one, while the context lasts.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        with tempfile.TemporaryDirectory(prefix="bevcli-") as folder:
            link = Path(folder, "file").with_suffix(valid_text(path.suffix))
            link.symlink_to(path.absolute())
            yield str(link)
    else:
        yield str(path)


def _size(count: int) -> str:
    return f"{count} bytes" if count < MIB else f"{count / MIB:.0f} MiB"


def run_python(
    code: str, arguments: Sequence[object], memory: int, seconds: float, environment: Mapping[str, str] = os.environ
) -> subprocess.CompletedProcess[bytes]:
    """Run Python code with the packages that this process finds, not with those of the folder.

    memory: bytes that the process may use from where the code calls `limit_memory()`, after its imports.
    Raises subprocess.TimeoutExpired.
    """
    paths = {"PYTHONPATH": os.pathsep.join(sys.path), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-P", "-c", LIMIT_MEMORY.format(memory=memory) + code, *map(str, arguments)]
    return run_program(command, seconds, {**environment, **paths})


def run_program(
    command: Sequence[str], seconds: float, environment: Mapping[str, str]
) -> subprocess.CompletedProcess[bytes]:
    """Run a program that reads nothing. Raises subprocess.TimeoutExpired; any exception ends the program."""
    return subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, env=environment, check=False, timeout=seconds
    )
