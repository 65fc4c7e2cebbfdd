"""Reads whole files and images within limits of size; other programs read within limits of time and memory.

Pipes, devices and sockets are refused: they may not end.
"""

import hashlib
import json
import os
import re
import stat
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from bevcli.errors import BevcliError, InputError
from bevcli.printing import valid_text

if TYPE_CHECKING:
    from numpy.typing import NDArray

MIB = 1 << 20
JPEG_QUALITY = 90
VIDEO_SUFFIXES = (".mp4", ".mkv", ".avi", ".webm", ".mov", ".m4v")
# Markers of a JPEG that state its size (start of frame): all from C0 to CF except DHT, JPG and DAC.
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_PIXELS, _END = 0xDA, 0xD9
_MARKER = re.compile(rb"\xff[^\x00\x01\xd0-\xd8\xff]")  # those that have a length, and the end
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
OTHERS = ("WEBP", "TIFF", "BMP")  # formats that Pillow and OpenCV read
# RLIMIT_DATA, and not the address space: allocators reserve more than they use.
LIMIT_MEMORY = """
def limit_memory():
    try:
        import resource
        resource.setrlimit(resource.RLIMIT_DATA, ({memory}, {memory}))
    except (ImportError, ValueError, OSError):
        pass
"""


def is_there(path: Path) -> bool:
    """True if a file that may be missing is there. It may be a pipe or a broken link, which is an error when read."""
    return os.path.lexists(path)


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
) -> BinaryIO:
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
    """SHA-256 of the contents of a file, hexadecimal. Raises OSError."""
    with path.open("rb") as file:
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


def media_type_of(encoded: bytes) -> str | None:
    """The media type of an encoded image: "image/jpeg", "image/png", or None for another format."""
    if encoded.startswith(b"\xff\xd8\xff"):
        return "image/jpeg"
    return "image/png" if encoded.startswith(b"\x89PNG\r\n\x1a\n") else None


def decode_image(encoded: bytes, flags: int, most_pixels: int) -> "NDArray | None":
    """The pixels of a whole image file, as `cv2.imdecode` gives them.

    None for another format, a damaged or cut file, and for an image with more than `most_pixels` pixels.
    """
    size = size_of_image(encoded)
    if size is None or not 0 < size[0] * size[1] <= most_pixels or _is_cut_short(encoded):
        return None
    import cv2  # which `--help` must not import
    import numpy as np

    try:
        return cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), flags)
    except cv2.error:
        return None


def encode_image(pixels: "NDArray", ending: str = ".jpg", quality: int = JPEG_QUALITY) -> bytes:
    """The file of an image with blue, green and red channels, or one channel. quality: of a JPEG, 1 to 100."""
    import cv2

    settings = [] if ending == ".png" else [cv2.IMWRITE_JPEG_QUALITY, quality]
    return cv2.imencode(ending, pixels, settings)[1].tobytes()


def size_of_image(encoded: bytes) -> tuple[int, int] | None:
    """(width, height) in pixels as the header of an image file states it; None where it states none."""
    kind = media_type_of(encoded)
    if kind == "image/png":
        if len(encoded) < 24 or encoded[12:16] != b"IHDR":
            return None
        width, height = struct.unpack(">II", encoded[16:24])
        return width, height
    if kind == "image/jpeg":
        for marker, offset in _jpeg_markers(encoded):
            if marker in _FRAMES and offset + 7 <= len(encoded):
                height, width = struct.unpack(">HH", encoded[offset + 3 : offset + 7])
                return width, height
            if marker in _FRAMES or marker == _PIXELS:
                break
        return None
    from PIL import Image

    try:
        with Image.open(BytesIO(encoded), formats=OTHERS) as image:
            return image.size
    except Exception:  # of many types for broken bytes
        return None


def _jpeg_markers(encoded: bytes) -> Iterator[tuple[int, int]]:
    """Each marker of a JPEG that has a length, or is the end, and the offset behind it."""
    offset = 2
    while marker := _MARKER.search(encoded, offset):
        yield encoded[marker.end() - 1], marker.end()
        offset = marker.end() + int.from_bytes(encoded[marker.end() : marker.end() + 2], "big")


def _is_cut_short(encoded: bytes) -> bool:
    """True if the end of a JPEG or PNG is missing. OpenCV fills it with grey, and allocates what a chunk states.

    Bytes after the end, such as the video of a motion photo, do not matter.
    """
    kind = media_type_of(encoded)
    if kind == "image/jpeg":
        return _END not in (marker for marker, _ in _jpeg_markers(encoded))  # a thumbnail's end lies in its segment
    if kind is None:
        return False  # OpenCV refuses those of the other formats
    offset = 8
    while offset + 12 <= len(encoded):  # a chunk of a PNG: length, kind, contents, checksum
        chunk = encoded[offset + 4 : offset + 8]
        offset += 12 + int.from_bytes(encoded[offset : offset + 4], "big")
        if chunk == b"IEND":
            return offset > len(encoded)
    return True
