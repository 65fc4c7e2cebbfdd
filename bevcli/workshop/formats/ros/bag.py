"""The files of one recording as topics with indexed messages."""

import importlib.util
import re
import threading
from collections.abc import Callable, Iterator, Sequence as Indices
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import BevcliError, InputError
from bevcli.parsing.documents import read_yaml
from bevcli.parsing.files import MIB, decompressed
from bevcli.printing import reason_of
from bevcli.workshop.formats.ros.format import METADATA, SUFFIXES, is_packed_bag
from bevcli.workshop.formats.ros.messages import decoder

if TYPE_CHECKING:
    from bevcli.workshop.formats.ros.storage import McapFile, SqliteFile

SPLIT_NUMBER = re.compile(r"_\d+$")  # rosbag2 numbers the files of a recording: drive_0.mcap, drive_1.mcap
LARGEST_MESSAGE = 256 * MIB  # bytes after decompression
MOST_INVALID = 1000  # messages of a topic before the first valid one
PACKAGES = ("mcap", "rosbags", "google.protobuf")
_Value = TypeVar("_Value")


@contextmanager
def _broken_files_refused(path: Path) -> Iterator[None]:
    """Makes one InputError of one line of what the packages for MCAP, SQLite and ROS raise for broken bytes."""
    try:
        yield
    except Exception as error:
        reason = reason_of(error)
        if isinstance(error, BevcliError):
            raise type(error)(reason if str(path) in reason else f"{path}: {reason}") from None
        raise InputError(f"{path}: is damaged ({reason:.200})") from None


class Bag:
    """A recording of one or more files. Messages are numbered by topic, in order of time. Safe to use from threads.

    Raises InputError if a file is missing or broken, or the packages of the extra `ros` are not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.RLock()
        self._compression = ""
        with _broken_files_refused(path):
            self.file_paths = tuple(self._file_paths())
            self._files = [_open_file(file) for file in self.file_paths]
            self.size = sum(file.stat().st_size for file in self.file_paths)  # bytes
        self.topics = {name: topic for file in self._files for name, topic in sorted(file.topics.items())}
        self._decoder = cache(lambda topic: decoder(self.topics[topic]))

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user about the files."""
        return tuple(note for file in self._files for note in file.notes)

    def times(self, topic: str) -> NDArray[np.int64]:
        """(N,) log times of a topic's messages, ns. They come from the index."""
        with self._lock, _broken_files_refused(self.path):
            parts = [file.times(topic) for file in self._files if topic in file.topics]
        return np.concatenate([np.zeros(0, dtype=np.int64), *parts])

    def message(self, topic: str, index: int) -> Any:
        """Message `index` of a topic, from 0. Raises InputError if it is broken."""
        with self._lock, _broken_files_refused(self.path):
            data, decode = self._bytes(topic, index), self._decoder(topic)
        try:
            return decode(data)
        except Exception as error:  # the decoders of the packages raise errors of many types for broken bytes
            reason = reason_of(error)
            raise InputError(f"{self.path}: {topic}: message {index} cannot be decoded ({reason:.200})") from None

    def read(self, topic: str, index: int, parse: Callable[[Any], _Value], kind: str) -> _Value:
        """The value that `parse` makes of a message. Raises InputError also if it is not `kind`, such as "a pose"."""
        message = self.message(topic, index)
        try:
            return parse(message)
        except (AttributeError, ValueError) as error:
            raise InputError(f"{self.path}: {topic}: message {index} is not {kind} ({error})") from None

    def first(self, topic: str, parse: Callable[[Any], _Value], kind: str) -> _Value:
        """The first value of a topic's messages that is valid, and not empty: nodes publish before they are set up.

        Raises InputError as `read` for the first message, if no message has a value.
        """
        values: list[_Value] = []
        invalid: InputError | None = None
        for index in range(min(len(self.times(topic)), MOST_INVALID)):
            try:
                values.append(self.read(topic, index, parse, kind))
            except InputError as error:
                invalid = invalid or error
            if values and values[-1]:
                break
        if not values and invalid is not None:
            raise invalid
        return values[-1]

    def _bytes(self, topic: str, index: int) -> bytes:
        for file in self._files:
            count = len(file.times(topic)) if topic in file.topics else 0
            if index < count:
                data = file.read(topic, index)
                return decompressed("zstd", data, LARGEST_MESSAGE) if self._compression == "message" else data
            index -= count
        raise IndexError(f"{topic} has no message {index}")

    def _file_paths(self) -> list[Path]:
        """The files in order. Also notes whether rosbag2 compressed single messages."""
        if self.path.is_file():
            return [self.path]
        found = sorted(file for file in self.path.iterdir() if file.suffix in SUFFIXES)
        stated = _metadata(self.path / METADATA)
        listed = [self.path / Path(name).name for name in stated.get("relative_file_paths", [])]
        mode = str(stated.get("compression_mode", "")).lower()
        packed = sorted(file.name for file in self.path.iterdir() if is_packed_bag(file))
        if packed and not found:
            raise InputError(f"{self.path}: its files are compressed: decompress them first (zstd -d {packed[0]})")
        self._compression = mode
        paths = [file for file in listed if file.suffix in SUFFIXES and file.is_file()] or found
        if not listed and len({SPLIT_NUMBER.sub("", file.stem) for file in paths}) > 1:
            names = ", ".join(file.name for file in paths[:4])
            raise InputError(f"{self.path}: has several bags and no {METADATA}: pass one of them ({names})")
        if not paths:
            raise InputError(f"{self.path}: has no .mcap or .db3 file (expected those listed in {METADATA})")
        return sorted(paths, key=_number) if not listed else paths


def _metadata(path: Path) -> dict[str, Any]:
    """The statements of metadata.yaml; empty without the file, which a recording that was cut off does not have."""
    try:
        document = read_yaml(path)
    except InputError:
        return {}
    found = document.get("rosbag2_bagfile_information") if isinstance(document, dict) else None
    return found if isinstance(found, dict) else {}


def _open_file(path: Path) -> "McapFile | SqliteFile":
    try:
        installed = all(map(importlib.util.find_spec, PACKAGES))
    except ModuleNotFoundError:  # the package around one of them
        installed = False
    if not installed:
        raise InputError(f"{path}: ROS bags need the packages of an extra: run pip install 'bevcli[ros]'")
    from bevcli.workshop.formats.ros.storage import McapFile, SqliteFile

    if not path.stat().st_size:
        raise InputError(f"{path}: the file is empty")
    return McapFile(path) if path.suffix == ".mcap" else SqliteFile(path)


def _number(file: Path) -> tuple[int, str]:
    digits = file.stem.rpartition("_")[2]
    return (int(digits) if digits.isdigit() else 0, file.name)


def spread(count: int, wanted: int) -> Indices[int]:
    """Up to `wanted` different indices below `count`, evenly spread, with the first and the last."""
    indices: list[int] = np.unique(np.linspace(0, count - 1, min(count, wanted)).astype(int)).tolist()
    return indices
