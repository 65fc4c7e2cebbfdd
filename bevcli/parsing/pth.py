"""Reads a PyTorch file (.pth) in the zip format and in the older one, by `torch.load(weights_only=True)`.

PyTorch's restricted unpickler calls nothing but what makes tensors and plain values. For classes that it does not know,
such as those of MMCV and NumPy in the metadata of released files, it gets stand-ins that do nothing, so that the
tensors beside them can be read. A file that names what runs programs is refused, and so is a compressed archive, which
may be a bomb.
"""

import pickle
import pickletools
import struct
import threading
import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import torch

from bevcli.errors import WeightsError
from bevcli.parsing.files import open_regular, plain_name

MOST_OPCODES = 2_000_000  # the checkpoint of the base model, optimizer included, has about 100,000
NEWEST_PROTOCOL = 3  # of pickles that PyTorch reads with weights_only; torch.save writes 2
PICKLES = 4  # of the older format, before the storages: magic number, protocol, system, contents
# Modules whose functions run programs or code. Nothing of a file is ever called, but such a file is an attack.
_ATTACKS = frozenset(("os", "posix", "nt", "subprocess", "sys", "pty", "runpy", "importlib", "shutil", "socket"))
_ATTACKING_BUILTINS = frozenset(("eval", "exec", "execfile", "compile", "__import__", "open", "input"))
# The exceptions of PyTorch and of Python's zip and pickle readers for a damaged file.
_DAMAGE = (pickle.UnpicklingError, zipfile.BadZipFile, RuntimeError, LookupError, AttributeError, TypeError, ValueError,
           ArithmeticError, AssertionError, EOFError, OSError, MemoryError, struct.error)  # fmt: skip

_LOADING = threading.Lock()


class Placeholder:
    """Stands for an object that was left out. made_by: the class or function that would have made it."""

    made_by = ""

    def __setstate__(self, state: Any) -> None:
        """Leaves out attributes."""


@dataclass(frozen=True)
class PthFile:
    """The contents of a PyTorch file."""

    # dicts, lists, tuples, plain values, `Placeholder`s, and tensors on the CPU that may be mapped from the file: copy
    # what must outlive it
    contents: Any
    left_out: tuple[str, ...]  # names of the classes and functions whose objects were left out, sorted


def read_pth(path: Path) -> PthFile:
    """The contents of a PyTorch file, of which nothing runs. Raises WeightsError."""
    with open_regular(path, missing="weights file not found", error=WeightsError) as file:
        try:
            is_zip = file.read(4) == b"PK\x03\x04"
            file.seek(0)
            names = _names_in_zip(file) if is_zip else {name for _ in range(PICKLES) for name in _names_in_pickle(file)}
        except _DAMAGE as error:
            raise _damaged(path, error) from None
    for module, name in names:
        root = module.partition(".")[0]
        if root in _ATTACKS or (root in ("builtins", "__builtin__") and name in _ATTACKING_BUILTINS):
            raise WeightsError(
                f"{path}: is not safe to read: it calls {module}.{name}, which can run programs. "
                "Nothing in it was run; do not use this file"
            )
    left_out: set[str] = set()
    stand_ins: list[Any] = [(_stand_in(f"{module}.{name}", left_out), f"{module}.{name}") for module, name in names]
    try:
        with plain_name(path) as name:
            # A mapped storage cannot reach beyond the file, whatever size the pickle states.
            contents = load_data(name, stand_ins, mmap=is_zip)
    except _DAMAGE as error:
        raise _damaged(path, error) from None
    for value in (contents, *(dict.values(contents) if isinstance(contents, dict) else ())):
        if isinstance(value, OrderedDict):
            vars(value).clear()  # attributes that the file sets could stand in for its methods
    return PthFile(contents, tuple(sorted(left_out)))


def load_data(source: Any, classes: Iterable[Any], **settings: Any) -> Any:
    """The contents of a PyTorch file: tensors on the CPU, plain values, and objects of these classes alone.

    One thread at a time: the classes that PyTorch allows are global.

    Args:
        source: a path or an open file.
        classes: see `torch.serialization.safe_globals`.
        settings: of `torch.load`.

    Raises what PyTorch raises for a damaged file or another class.
    """
    with _LOADING, torch.serialization.safe_globals(list(classes)), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyTorch warns of types in the file that it will cease to know
        return torch.load(source, map_location="cpu", weights_only=True, **settings)


def _stand_in(name: str, left_out: set[str]) -> type:
    """A class in place of a class or function that PyTorch does not know. left_out: gets its name where it is called.

    What is named like a dict or a list becomes one, as PyTorch's unpickler puts items into nothing else.
    """

    def make(cls: type, *_: object, **__: object) -> object:
        left_out.add(name)
        if name.lower().endswith("dict"):
            return OrderedDict()
        return [] if name.lower().endswith(("list", "deque")) else object.__new__(cls)

    return type("StandIn", (Placeholder,), {"__new__": make, "made_by": name})


def _names_in_zip(file: IO[bytes]) -> set[tuple[str, str]]:
    with zipfile.ZipFile(file) as archive:
        for entry in archive.infolist():
            if entry.compress_type != zipfile.ZIP_STORED or entry.compress_size != entry.file_size:
                raise ValueError(f"{entry.filename} is compressed (expected uncompressed, as PyTorch writes it)")
        folder = archive.namelist()[0].partition("/")[0] if archive.namelist() else ""
        with archive.open(f"{folder}/data.pkl") as data:
            return set(_names_in_pickle(data))


def _names_in_pickle(file: IO[bytes]) -> Iterator[tuple[str, str]]:
    """Module and name of each class and function in the pickle that starts here; builtins by Python 3's name."""
    argument: Any
    for count, (opcode, argument, _) in enumerate(pickletools.genops(file)):
        if count == MOST_OPCODES:
            raise ValueError(f"more than {MOST_OPCODES} opcodes")
        if opcode.name == "PROTO" and argument > NEWEST_PROTOCOL:
            raise ValueError(f"its pickle protocol is {argument}: save it anew with 2, the default of torch.save")
        if opcode.name == "GLOBAL":
            module, _, name = argument.partition(" ")
            yield "builtins" if module == "__builtin__" else module, name


def _damaged(path: Path, error: Exception) -> WeightsError:
    reason = " ".join(str(error).rpartition("WeightsUnpickler error:")[2].split())  # without PyTorch's advice
    return WeightsError(
        f"{path}: not a weights file that is safe to read (expected .safetensors, or a PyTorch file of tensors and "
        f"plain values): it is damaged, is another kind of file, or holds objects that could run code ({reason:.200})"
    )
