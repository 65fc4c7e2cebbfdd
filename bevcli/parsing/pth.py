"""Reads the tensors of a PyTorch file (.pth), in the zip format and in the older one, and runs nothing in it.

Tensors and plain values are read. Whatever else the file names becomes a `Placeholder`: it is neither imported nor
called. The tensors that a pickle describes are checked against the bytes that the file has before any is made.
"""

from __future__ import annotations

import contextlib
import io
import math
import struct
import sys
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor

from bevcli.errors import WeightsError
from bevcli.parsing.files import open_regular
from bevcli.parsing.pickles import Global, PickleError, PickleReader, Placeholder

LARGEST_PICKLE = 32 << 20
LARGEST_TENSORS = 8 << 30  # bytes of all tensors that are read
MOST_DIMENSIONS = 16
LARGEST_SIZE = 2**40  # elements of a tensor, repeated ones included
# What Python's zip reader raises for a damaged archive, and this module for a damaged pickle.
_DAMAGE = (PickleError, zipfile.BadZipFile, RuntimeError, KeyError, ValueError, OSError, EOFError, struct.error)
_OLD_FORMAT = 0x1950A86A20F9469CFC6C  # the first number in a file of the older format
_DTYPES = {
    "FloatStorage": torch.float32,
    "DoubleStorage": torch.float64,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
    "ComplexFloatStorage": torch.complex64,
    "ComplexDoubleStorage": torch.complex128,
}
# Modules whose functions run programs or code. Nothing of a file is ever called, but such a file is an attack.
_ATTACKS = frozenset(("os", "posix", "nt", "subprocess", "sys", "pty", "runpy", "importlib", "shutil", "socket"))
_ATTACKING_BUILTINS = frozenset(("eval", "exec", "execfile", "compile", "__import__", "open", "input"))


@dataclass(frozen=True)
class PthFile:
    """The contents of a PyTorch file.

    Attributes:
        contents: dicts, lists, tuples, plain values, `StoredTensor` and `Placeholder`.
        left_out: names of the classes and functions whose objects were left out, sorted.
    """

    contents: Any
    left_out: tuple[str, ...]
    _storages: _Storages = field(repr=False)

    def tensors(self, stored: Mapping[str, StoredTensor]) -> dict[str, Tensor]:
        """The tensors of a state dict. Raises WeightsError where one does not fit the bytes that the file has."""
        with self._storages:
            return {name: self._storages.tensor(name, described) for name, described in stored.items()}

    def with_tensors(self) -> Any:
        """The contents with tensors in place of `StoredTensor`.

        Raises WeightsError as `tensors`, and RecursionError where a list contains itself.
        """
        with self._storages:
            return self._filled(self.contents, "")

    def _filled(self, value: Any, name: str) -> Any:
        if isinstance(value, StoredTensor):
            return self._storages.tensor(name, value)
        if isinstance(value, dict):
            return {key: self._filled(item, f"{name}.{key}".lstrip(".")) for key, item in value.items()}
        if isinstance(value, list | tuple):
            items = [self._filled(item, f"{name}.{place}".lstrip(".")) for place, item in enumerate(value)]
            return items if isinstance(value, list) else tuple(items)
        return value


@dataclass(frozen=True, eq=False)
class Storage:
    """A row of numbers in the file.

    Attributes:
        key: its name in the file.
        dtype: of the numbers.
        count: how many there are, by the pickle.
    """

    key: str
    dtype: torch.dtype
    count: int


@dataclass(frozen=True, eq=False)
class StoredTensor:
    """A tensor as the pickle describes it, not checked yet.

    Attributes:
        storage: where its numbers are.
        offset: index of its first number.
        shape: sizes.
        strides: in numbers, one a dimension.
    """

    storage: Any
    offset: Any
    shape: Any
    strides: Any


def read_pth(path: Path) -> PthFile:
    """The contents of a PyTorch file. Raises WeightsError."""
    file = open_regular(path, missing="weights file not found", error=WeightsError)
    with file:
        try:
            start = file.read(4)
            file.seek(0)
            return _read_zip(path, file) if start == b"PK\x03\x04" else _read_old(path, file)
        except _DAMAGE as error:
            raise _damaged(path, str(error)) from None


class _Calls:
    """What becomes of the calls and persistent ids in a file, and the names of what is left out."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.left_out: set[str] = set()
        self.storages: dict[str, Storage] = {}

    def call(self, function: Global, arguments: tuple[Any, ...]) -> Any:
        name = str(function)
        if name in ("collections.OrderedDict", "collections.defaultdict"):
            return {}
        if name in ("torch._utils._rebuild_tensor_v2", "torch._utils._rebuild_tensor") and len(arguments) >= 4:
            return StoredTensor(*arguments[:4])
        if name in ("torch._utils._rebuild_parameter", "torch._utils._rebuild_parameter_with_state") and arguments:
            return arguments[0]
        if name == "torch.Size":
            return arguments[0] if len(arguments) == 1 else ()
        root = function.module.split(".")[0]
        builtin = root in ("builtins", "__builtin__") and function.name in _ATTACKING_BUILTINS
        if root in _ATTACKS or builtin:
            raise WeightsError(
                f"{self._path}: is not safe to read: it calls {name}, which can run programs. "
                "Nothing in it was run; do not use this file"
            )
        self.left_out.add(name)
        return Placeholder(function)

    def persistent(self, pid: Any) -> Storage:
        if not (isinstance(pid, tuple) and len(pid) >= 5 and pid[0] == "storage" and isinstance(pid[1], Global)):
            raise PickleError("a persistent id that is no storage")
        kind, key, count = pid[1], pid[2], pid[4]
        if not (isinstance(key, str) and len(key) < 100 and type(count) is int and count >= 0):
            raise PickleError("a storage without name or size")
        if len(pid) > 5 and pid[5] is not None:
            raise PickleError("a storage that is a part of another")
        dtype = _DTYPES.get(kind.name) if kind.module in ("torch", "torch.cuda", "torch.storage") else None
        if dtype is None:
            raise PickleError(f"numbers of the unsupported type {kind}")
        storage = self.storages.setdefault(key, Storage(key, dtype, count))
        if (storage.dtype, storage.count) != (dtype, count):
            raise PickleError(f"two descriptions of the storage {key}")
        return storage


class _Storages(contextlib.ExitStack):
    """Reads storages when a tensor needs them, each once. The file is open inside a `with` block."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path
        self._read: dict[str, Tensor] = {}
        self._bytes = 0

    def tensor(self, name: str, stored: StoredTensor) -> Tensor:
        storage, offset = stored.storage, stored.offset
        if not isinstance(storage, Storage):
            raise WeightsError(f"{self._path}: tensor {name}: has no numbers in the file")
        shape, strides = _sizes(stored.shape), _sizes(stored.strides)
        if shape is None or strides is None or len(shape) != len(strides) or type(offset) is not int or offset < 0:
            raise WeightsError(f"{self._path}: tensor {name}: its shape is damaged")
        last = offset + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
        # A tensor may repeat numbers by a stride of 0, but not by overlapping rows: those only inflate a small file.
        distinct = math.prod(size for size, stride in zip(shape, strides, strict=True) if stride)
        if math.prod(shape) > LARGEST_SIZE or distinct > storage.count or (0 not in shape and last >= storage.count):
            raise WeightsError(
                f"{self._path}: tensor {name}: its shape {shape} reaches beyond its {storage.count} numbers in the file"
            )
        if storage.key not in self._read:
            self._read[storage.key] = self._load(storage)
        return self._read[storage.key].as_strided(shape, strides, offset)

    def _load(self, storage: Storage) -> Tensor:
        size = storage.count * storage.dtype.itemsize
        self._bytes += size
        if self._bytes > LARGEST_TENSORS:
            raise WeightsError(f"{self._path}: its tensors have more than {LARGEST_TENSORS >> 30} GiB")
        if not size:
            return torch.empty(0, dtype=storage.dtype)
        try:
            data = self.read(storage.key, size)
        except _DAMAGE as error:
            raise _damaged(self._path, f"storage {storage.key}: {error}") from None
        return torch.frombuffer(data, dtype=storage.dtype)

    def read(self, key: str, size: int) -> bytearray:
        """The bytes of a storage."""
        raise NotImplementedError


class _ZipStorages(_Storages):
    def __init__(self, path: Path, folder: str) -> None:
        super().__init__(path)
        self._folder = folder
        self._archive: zipfile.ZipFile | None = None

    def read(self, key: str, size: int) -> bytearray:
        if self._archive is None:
            self._archive = self.enter_context(zipfile.ZipFile(self._path))
        return bytearray(_entry(self._archive, f"{self._folder}/data/{key}", size, size))


class _OldStorages(_Storages):
    """Storages of the older format: offset and byte count of each, by key."""

    def __init__(self, path: Path, places: Mapping[str, tuple[int, int]]) -> None:
        super().__init__(path)
        self._places = places

    def read(self, key: str, size: int) -> bytearray:
        offset, found = self._places[key]
        if found != size:
            raise PickleError(f"has {found} bytes (expected {size})")
        data = bytearray(size)
        with self._path.open("rb") as file:
            file.seek(offset)
            if file.readinto(data) < size:
                raise PickleError("is cut off")
        return data


def _read_zip(path: Path, file: BinaryIO) -> PthFile:
    with zipfile.ZipFile(file) as archive:
        folder = archive.namelist()[0].split("/")[0] if archive.namelist() else ""
        if f"{folder}/byteorder" in archive.namelist():
            order = _entry(archive, f"{folder}/byteorder", None, 10)
            if order.decode("ascii", "replace") != sys.byteorder:
                raise PickleError(f"its numbers have the byte order {order!r}")
        data = _entry(archive, f"{folder}/data.pkl", None, LARGEST_PICKLE)
    calls = _Calls(path)
    contents = PickleReader(io.BytesIO(data), calls.call, calls.persistent).read()
    return PthFile(contents, tuple(sorted(calls.left_out)), _ZipStorages(path, folder))


def _entry(archive: zipfile.ZipFile, name: str, expected: int | None, largest: int) -> bytes:
    """A file of the archive. It must be uncompressed, as PyTorch writes it: a compressed one could be a bomb."""
    info = archive.getinfo(name)
    if info.compress_type != zipfile.ZIP_STORED or info.compress_size != info.file_size:
        raise PickleError(f"{name} is compressed (expected uncompressed, as PyTorch writes it)")
    if info.file_size > largest or (expected is not None and info.file_size != expected):
        raise PickleError(f"{name} has {info.file_size} bytes (expected {largest if expected is None else expected})")
    with archive.open(info) as entry:
        data = entry.read(info.file_size)
    if len(data) < info.file_size:
        raise PickleError(f"{name} is cut off")
    return data


def _read_old(path: Path, file: BinaryIO) -> PthFile:
    """magic number, protocol, system facts, contents and storage keys as pickles, then the storages."""
    if PickleReader(file).read() != _OLD_FORMAT:
        raise PickleError("another kind of file")
    PickleReader(file).read()
    facts = PickleReader(file).read()
    if isinstance(facts, dict) and facts.get("little_endian", True) != (sys.byteorder == "little"):
        raise PickleError("its numbers have another byte order")
    calls = _Calls(path)
    contents = PickleReader(file, calls.call, calls.persistent).read()
    keys = PickleReader(file).read()
    if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys):
        raise PickleError("the list of its storages is damaged")
    places: dict[str, tuple[int, int]] = {}
    for key in keys:
        header = file.read(8)
        if len(header) < 8 or key not in calls.storages:
            raise PickleError(f"storage {key:.50} is missing")
        storage = calls.storages[key]
        if struct.unpack("<q", header)[0] != storage.count:
            raise PickleError(f"storage {key:.50} has another size than the pickle states")
        size = storage.count * storage.dtype.itemsize
        places[key] = (file.tell(), size)
        file.seek(size, io.SEEK_CUR)
    return PthFile(contents, tuple(sorted(calls.left_out)), _OldStorages(path, places))


def _sizes(value: Any) -> tuple[int, ...] | None:
    """Sizes or strides: at most 16 integers, none negative; None where they are something else."""
    if not isinstance(value, tuple | list) or len(value) > MOST_DIMENSIONS:
        return None
    return tuple(value) if all(type(size) is int and 0 <= size < 2**62 for size in value) else None


def _damaged(path: Path, reason: str) -> WeightsError:
    return WeightsError(
        f"{path}: not a weights file that is safe to read (expected .safetensors, or a PyTorch file of tensors and "
        f"plain values): it is damaged, is another kind of file, or holds objects that could run code ({reason:.200})"
    )
