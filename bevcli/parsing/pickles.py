"""Reads a pickle as data: nothing that it names is imported, and nothing that it asks for is called.

The unpickler is that of the standard library in its Python form, whose table of opcodes can be replaced. Only the
opcodes that `torch.save` writes are left in it. A name in the file becomes a `Global`, which is only a pair of strings,
and a call becomes whatever `PickleReader.call` makes of it, here a `Placeholder`. Attributes that the file wants to set
are left out.
"""

import io
import pickle
import pickletools
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

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
_DAMAGE = (
    pickle.UnpicklingError, EOFError, LookupError, AttributeError, TypeError, ValueError, OverflowError, struct.error
)  # fmt: skip


class PickleError(Exception):
    """The pickle is damaged, is beyond a limit, or has an opcode that `torch.save` does not write."""


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


class PickleReader(pickle._Unpickler):
    """Python's unpickler, with plain objects in place of whatever a file could call."""

    stack: list[Any]
    pop_mark: Callable[[], list[Any]]

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, encoding="utf-8", errors="replace")
        self._file = file

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
        except _DAMAGE as error:
            raise PickleError(f"damaged value ({error})") from None

    def call(self, function: Global, arguments: tuple[Any, ...]) -> Any:
        """The object for a call of a global."""
        return Placeholder(function)

    def find_class(self, module: str, name: str) -> Global:
        """The name of a class or function: nothing is imported."""
        return Global(module, name)

    def persistent_load(self, pid: Any) -> Any:
        raise PickleError("a persistent id outside of a PyTorch file")

    def _reduce(self) -> None:
        arguments, function = self.stack.pop(), self.stack.pop()
        if isinstance(function, Placeholder):  # a call of what an unknown call returned, such as getattr(…)
            self.stack.append(function)
        elif isinstance(function, Global) and isinstance(arguments, tuple):
            self.stack.append(self.call(function, arguments))
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
