"""Reads a pickle of plain values and of NumPy's arrays of numbers, from which nothing is called or imported."""

import io
import pickle
import pickletools
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array
from bevcli.parsing.files import MIB, read_bytes
from bevcli.printing import reason_of

LARGEST_BYTES, MOST_OPCODES = 256 * MIB, 3_000_000
NUMBERS = ("f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1")


class StoredType:
    """Stands for the type of an array's numbers."""

    def __init__(self, name: object, *_: object) -> None:
        self.name, self.order = str(name), "<"

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = str(state[1])

    def numbers(self, stored: object) -> Array | None:
        """(N,) numbers of bytes; None for other types, such as texts."""
        if self.name not in NUMBERS or not isinstance(stored, (bytes, bytearray)):
            return None
        return np.frombuffer(stored, dtype=(">" if self.order == ">" else "<") + self.name)


class StoredArray:
    """Stands for an array. `numbers` is None for one without numbers."""

    numbers: Array | None = None

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, kind, is_fortran, stored = state
        numbers = kind.numbers(stored)
        self.numbers = None if numbers is None else numbers.reshape(shape, order="F" if is_fortran else "C")

    def __array__(self, dtype: Any = None, copy: Any = None) -> Array:
        return np.array(self.numbers, dtype=dtype)


def _of_buffer(stored: Any, kind: StoredType, shape: Any, order: str) -> StoredArray:
    array = StoredArray()
    array.__setstate__((1, shape, kind, order == "F", bytes(stored)))
    return array


def _scalar(kind: StoredType, stored: Any) -> Any:
    numbers = kind.numbers(stored)
    return None if numbers is None else numbers[0].item()


def _encode(text: str, _: object) -> bytes:
    return text.encode("latin1")


# What stands for the classes and functions that a pickle of NumPy's names.
STAND_INS: dict[tuple[str, str], Any] = {
    ("_codecs", "encode"): _encode, ("collections", "OrderedDict"): OrderedDict,
    ("numpy", "dtype"): StoredType, ("numpy", "ndarray"): StoredArray,
}  # fmt: skip
for core in ("numpy.core", "numpy._core"):
    STAND_INS[f"{core}.multiarray", "_reconstruct"] = lambda *_: StoredArray()
    STAND_INS[f"{core}.multiarray", "scalar"] = _scalar
    STAND_INS[f"{core}.numeric", "_frombuffer"] = _of_buffer


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in STAND_INS:
            raise pickle.UnpicklingError(f"it calls {module}.{name}, and was not read further")
        return STAND_INS[module, name]


def read_plain_pickle(path: Path) -> Any:
    """The contents of a pickle. Arrays are `StoredArray`s, which `numpy.array` takes. Raises InputError."""
    content = read_bytes(path, LARGEST_BYTES)
    try:
        for count, (opcode, argument, _) in enumerate(pickletools.genops(content)):
            if count > MOST_OPCODES:
                raise pickle.UnpicklingError("it has too many values: keep the entries of this drive")
            if "PUT" in opcode.name and isinstance(argument, int) and argument > count:  # it would take all memory
                raise pickle.UnpicklingError("it is damaged")
        return _Unpickler(io.BytesIO(content)).load()
    except Exception as error:  # a damaged pickle fails in many ways
        raise InputError(f"{path}: cannot be read as a pickle ({reason_of(error)[:200]})") from None
