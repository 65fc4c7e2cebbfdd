"""Reads the tensors of a PyTorch file (.pth) in the zip format and in the older one.

A pickle is read as data: nothing that it names is imported, and nothing that it asks for is called. The unpickler is
that of the standard library in its Python form, whose table of opcodes can be replaced. Only the opcodes that
`torch.save` writes are left in it. A name in the file becomes a `Global`, which is only a pair of strings, and the call
of anything but a tensor becomes a `Placeholder`. Attributes that the file wants to set are left out. The tensors that a
pickle describes are checked against the bytes that the file has before any is made.
"""

import contextlib
import io
import math
import pickle
import pickletools
import struct
import sys
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import torch
from torch import Tensor

from bevcli.errors import WeightsError
from bevcli.parsing.files import open_regular

MOST_OPCODES = 2_000_000  # the checkpoint of the base model, optimizer included, has about 100,000
_OPCODES = (
    "PROTO", "FRAME", "STOP", "MARK", "POP", "NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2",
    "BINFLOAT", "LONG1", "LONG4", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINSTRING", "SHORT_BINSTRING",
    "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "EMPTY_LIST",
    "APPEND", "APPENDS", "EMPTY_DICT", "SETITEM", "SETITEMS", "EMPTY_SET", "ADDITEMS", "FROZENSET", "BINPUT",
    "LONG_BINPUT", "MEMOIZE", "BINGET", "LONG_BINGET", "GLOBAL", "STACK_GLOBAL", "REDUCE", "NEWOBJ", "NEWOBJ_EX",
    "BUILD", "BINPERSID",
)  # fmt: skip
_CODES = {name: ord(getattr(pickle, name)) for name in _OPCODES}
# The exceptions of the standard library for a damaged pickle.
_PICKLE_DAMAGE = (
    pickle.UnpicklingError, EOFError, LookupError, AttributeError, TypeError, ValueError, OverflowError, struct.error
)  # fmt: skip
LARGEST_PICKLE = 32 << 20
LARGEST_TENSORS = 8 << 30  # bytes of all tensors that are read
MOST_DIMENSIONS = 16
MOST_ARGUMENTS = 16  # of a call that is read
LARGEST_SIZE = 2**40  # elements of a tensor, repeated ones included
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
_Read = Callable[[str, int], bytearray]  # the bytes of a storage, by its key and their number


class PickleError(Exception):
    """The pickle is damaged, is beyond a limit, or has an opcode that `torch.save` does not write."""


# The exceptions of Python's zip reader for a damaged archive, and of this package for a damaged pickle.
_DAMAGE = (PickleError, zipfile.BadZipFile, RuntimeError, KeyError, ValueError, OSError, EOFError, struct.error)


@dataclass(frozen=True)
class Global:
    """The name of a class or function."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


@dataclass(frozen=True, eq=False)
class Placeholder:
    """Stands for an object that `made_by` would have made. Elements that the file adds to it are left out."""

    made_by: Global

    def append(self, element: Any) -> None:
        """Leaves out an element of a list."""

    def add(self, element: Any) -> None:
        """Leaves out an element of a set."""


@dataclass(frozen=True, eq=False)
class Storage:
    """A row of `count` numbers, by the pickle. key: its name in the file."""

    key: str
    dtype: torch.dtype
    count: int


@dataclass(frozen=True, eq=False)
class StoredTensor:
    """A tensor as the pickle describes it, not checked yet. Offset and strides count numbers."""

    storage: Any
    offset: Any
    shape: Any
    strides: Any


_MADE: dict[str, Callable[..., Any]] = {
    "collections.OrderedDict": lambda *_: {},
    "collections.defaultdict": lambda *_: {},
    "torch._utils._rebuild_tensor": StoredTensor,
    "torch._utils._rebuild_tensor_v2": lambda *given: StoredTensor(*given[:4]),
    "torch._utils._rebuild_parameter": lambda tensor, *_: tensor,
    "torch._utils._rebuild_parameter_with_state": lambda tensor, *_: tensor,
    "torch.Size": lambda sizes=(), *_: sizes,
}


class PickleReader(pickle._Unpickler):
    """Python's unpickler, with plain objects in place of whatever a file could call.

    Attributes:
        left_out: names of the classes and functions whose objects are left out.
        storages: by their keys.
    """

    stack: list[Any]
    pop_mark: Callable[[], list[Any]]

    def __init__(self, file: io.BytesIO, path: Path) -> None:
        """path: of the file, for messages."""
        super().__init__(file, encoding="utf-8", errors="replace")
        self._file, self._path = file, path
        self.left_out: set[str] = set()
        self.storages: dict[str, Storage] = {}

    def load(self) -> Any:
        """The object in the pickle that starts here in the file. Raises PickleError."""
        start = self._file.tell()
        try:
            for count, (opcode, _, _) in enumerate(pickletools.genops(self._file)):
                if opcode.name not in _CODES:
                    raise PickleError(f"unsupported opcode {opcode.name}")
                if count == MOST_OPCODES:
                    raise PickleError(f"more than {MOST_OPCODES} opcodes")
            self._file.seek(start)
            return super().load()
        except _PICKLE_DAMAGE as error:
            raise PickleError(f"damaged value ({error})") from None

    def find_class(self, module: str, name: str) -> Global:
        """The name of a class or function: nothing is imported."""
        return Global(module, name)

    def persistent_load(self, pid: Any) -> Storage:
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

    def _call(self, function: Global, arguments: tuple[Any, ...]) -> Any:
        name = str(function)
        if name in _MADE:
            return _MADE[name](*arguments[:MOST_ARGUMENTS])
        root = function.module.split(".")[0]
        builtin = root in ("builtins", "__builtin__") and function.name in _ATTACKING_BUILTINS
        if root in _ATTACKS or builtin:
            raise WeightsError(
                f"{self._path}: is not safe to read: it calls {name}, which can run programs. "
                "Nothing in it was run; do not use this file"
            )
        self.left_out.add(name)
        return Placeholder(function)

    def _reduce(self) -> None:
        arguments, function = self.stack.pop(), self.stack.pop()
        if isinstance(function, Placeholder):  # a call of what an unknown call returned, such as getattr(…)
            self.stack.append(function)
        elif isinstance(function, Global) and isinstance(arguments, tuple):
            self.stack.append(self._call(function, arguments))
        else:
            raise PickleError("a call of something that is not a function")

    def _reduce_with_keywords(self) -> None:
        self.stack.pop()
        self._reduce()

    def _build(self) -> None:
        self.stack.pop()  # attributes are left out

    def _set_item(self) -> None:
        self._set([self.stack.pop(), self.stack.pop()][::-1])

    def _set_items(self) -> None:
        self._set(self.pop_mark())

    def _set(self, items: list[Any]) -> None:
        target = self.stack[-1]
        if len(items) % 2 or not isinstance(target, dict | Placeholder):
            raise PickleError("entries for something that is not a dict")
        for key, value in zip(items[::2], items[1::2], strict=True):
            if isinstance(target, dict) and _is_plain(key):
                target[key] = value

    def _empty_set(self) -> None:
        self.stack.append(Placeholder(Global("builtins", "set")))

    def _frozen_set(self) -> None:
        self.pop_mark()
        self.stack.append(Placeholder(Global("builtins", "frozenset")))

    dispatch: ClassVar[dict[int, Any]] = {code: pickle._Unpickler.dispatch[code] for code in _CODES.values()} | {
        _CODES["REDUCE"]: _reduce,
        _CODES["NEWOBJ"]: _reduce,
        _CODES["NEWOBJ_EX"]: _reduce_with_keywords,
        _CODES["BUILD"]: _build,
        _CODES["SETITEM"]: _set_item,
        _CODES["SETITEMS"]: _set_items,
        _CODES["EMPTY_SET"]: _empty_set,
        _CODES["FROZENSET"]: _frozen_set,
    }


def _is_plain(key: Any) -> bool:
    """True for a key of a dict that is read. Nested tuples and long integers may take for ever to hash."""
    if isinstance(key, int):
        return key.bit_length() <= 62
    return isinstance(key, str | float | bytes | None)


@dataclass(frozen=True)
class PthFile:
    """The contents of a PyTorch file.

    Attributes:
        contents: dicts, lists, tuples, plain values, `StoredTensor` and `Placeholder`.
        left_out: names of the classes and functions whose objects were left out, sorted.
    """

    contents: Any
    left_out: tuple[str, ...]
    _path: Path = field(repr=False)
    _open: Callable[[], contextlib.AbstractContextManager[_Read]] = field(repr=False)

    def with_tensors(self, part: Any = None) -> Any:
        """The contents, or a part of them, with tensors in place of `StoredTensor`.

        Raises WeightsError where a tensor does not fit the bytes that the file has, and for more than two million
        values: a tuple of a tuple of a tuple, each twice, is small in a file. RecursionError where a list contains
        itself.
        """
        with self._open() as read:
            return _Tensors(self._path, read).filled(self.contents if part is None else part, "")


def read_pth(path: Path) -> PthFile:
    """The contents of a PyTorch file. Raises WeightsError."""
    with open_regular(path, missing="weights file not found", error=WeightsError) as file:
        try:
            start = file.read(4)
            file.seek(0)
            return _read_zip(path, file) if start == b"PK\x03\x04" else _read_old(path, file)
        except _DAMAGE as error:
            raise _damaged(path, str(error)) from None


class _Tensors:
    """Makes tensors, for which it reads each storage once."""

    def __init__(self, path: Path, read: _Read) -> None:
        self._path, self._read = path, read
        self._loaded: dict[str, Tensor] = {}
        self._bytes = 0
        self._values = 0

    def filled(self, value: Any, name: str) -> Any:
        """A value with tensors in place of `StoredTensor`. name: of the value, for messages."""
        self._values += 1
        if self._values > MOST_OPCODES:
            raise WeightsError(
                f"{self._path}: has more than {MOST_OPCODES} values, those of repeated lists counted each time"
            )
        if isinstance(value, StoredTensor):
            return self._tensor(name, value)
        if isinstance(value, dict):
            return {key: self.filled(item, f"{name}.{key}".lstrip(".")) for key, item in value.items()}
        if isinstance(value, list | tuple):
            items = [self.filled(item, f"{name}.{place}".lstrip(".")) for place, item in enumerate(value)]
            return items if isinstance(value, list) else tuple(items)
        return value

    def _tensor(self, name: str, stored: StoredTensor) -> Tensor:
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
        if storage.key not in self._loaded:
            self._loaded[storage.key] = self._load(storage)
        return self._loaded[storage.key].as_strided(shape, strides, offset)

    def _load(self, storage: Storage) -> Tensor:
        size = storage.count * storage.dtype.itemsize
        self._bytes += size
        if self._bytes > LARGEST_TENSORS:
            raise WeightsError(f"{self._path}: its tensors have more than {LARGEST_TENSORS >> 30} GiB")
        if not size:
            return torch.empty(0, dtype=storage.dtype)
        try:
            data = self._read(storage.key, size)
        except _DAMAGE as error:
            raise _damaged(self._path, f"storage {storage.key}: {error}") from None
        return torch.frombuffer(data, dtype=storage.dtype)


def _read_zip(path: Path, file: BinaryIO) -> PthFile:
    with zipfile.ZipFile(file) as archive:
        folder = archive.namelist()[0].split("/")[0] if archive.namelist() else ""
        if f"{folder}/byteorder" in archive.namelist():
            order = _entry(archive, f"{folder}/byteorder", None, 10)
            if order.decode("ascii", "replace") != sys.byteorder:
                raise PickleError(f"its numbers have the byte order {order!r}")
        data = _entry(archive, f"{folder}/data.pkl", None, LARGEST_PICKLE)
    reader = PickleReader(io.BytesIO(data), path)
    contents = reader.load()

    @contextlib.contextmanager
    def open_storages() -> Iterator[_Read]:
        with zipfile.ZipFile(path) as archive:
            yield lambda key, size: bytearray(_entry(archive, f"{folder}/data/{key}", size, size))

    return PthFile(contents, tuple(sorted(reader.left_out)), path, open_storages)


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
    start = io.BytesIO(file.read(LARGEST_PICKLE))
    if PickleReader(start, path).load() != _OLD_FORMAT:
        raise PickleError("another kind of file")
    PickleReader(start, path).load()
    facts = PickleReader(start, path).load()
    if isinstance(facts, dict) and facts.get("little_endian", True) != (sys.byteorder == "little"):
        raise PickleError("its numbers have another byte order")
    reader = PickleReader(start, path)
    contents, keys = reader.load(), PickleReader(start, path).load()
    if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys):
        raise PickleError("the list of its storages is damaged")
    file.seek(start.tell())
    places: dict[str, int] = {}
    for key in keys:
        header = file.read(8)
        if len(header) < 8 or key not in reader.storages:
            raise PickleError(f"storage {key:.50} is missing")
        storage = reader.storages[key]
        if struct.unpack("<q", header)[0] != storage.count:
            raise PickleError(f"storage {key:.50} has another size than the pickle states")
        places[key] = file.tell()
        file.seek(storage.count * storage.dtype.itemsize, io.SEEK_CUR)

    @contextlib.contextmanager
    def open_storages() -> Iterator[_Read]:
        with path.open("rb") as file:
            yield lambda key, size: _part(file, places[key], size)

    return PthFile(contents, tuple(sorted(reader.left_out)), path, open_storages)


def _part(file: BinaryIO, offset: int, size: int) -> bytearray:
    data = bytearray(size)
    file.seek(offset)
    if file.readinto(data) < size:  # type: ignore[attr-defined]
        raise PickleError("is cut off")
    return data


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
