"""Reads a pickle as data: nothing that it names is imported, and nothing that it asks for is called.

Python's own unpickler imports and calls whatever a file names. This one knows the opcodes of protocol 2 to 5 that
`torch.save` writes. A name in the file becomes a `Global`, which is only a pair of strings; a call becomes whatever
`call` of the reader makes of it, by default a `Placeholder`. Attributes that the file wants to set are left out.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, BinaryIO

MOST_OPCODES = 2_000_000  # the checkpoint of the base model, optimizer included, has about 100,000
LONGEST_VALUE = 64 << 20  # bytes of a string or an integer


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
    """Stands for an object that is not read.

    Attributes:
        made_by: the class or function that would have made it.
    """

    made_by: Global

    def __str__(self) -> str:
        return str(self.made_by)


class _Mark:
    """The opcode MARK on the stack."""


_MARK = _Mark()
_KEYS = (str, int, float, bool, bytes, type(None))


@dataclass
class PickleReader:
    """Reads one pickle from a file.

    Attributes:
        file: at the start of the pickle; afterwards at its end.
        call: the object for a call of a global with a tuple of arguments.
        persistent: the object for a persistent id.
    """

    file: BinaryIO
    call: Callable[[Global, tuple[Any, ...]], Any] = lambda function, arguments: Placeholder(function)
    persistent: Callable[[Any], Any] | None = None
    _stack: list[Any] = field(default_factory=list)
    _memo: dict[int, Any] = field(default_factory=dict)

    def read(self) -> Any:
        """The object. Raises PickleError."""
        for _ in range(MOST_OPCODES):
            code = self._bytes(1)
            if code == b".":
                return self._pop()
            handler = _HANDLERS.get(code)
            if handler is None:
                raise PickleError(f"unsupported opcode {code!r}")
            try:
                handler(self)
            except (UnicodeDecodeError, OverflowError, ValueError, struct.error) as error:
                raise PickleError(f"damaged value ({error})") from None
        raise PickleError(f"more than {MOST_OPCODES} opcodes")

    def _bytes(self, count: int) -> bytes:
        if count > LONGEST_VALUE:
            raise PickleError(f"a value of {count} bytes")
        data = self.file.read(count)
        if len(data) < count:
            raise PickleError("the pickle is cut off")
        return data

    def _skip(self, count: int) -> None:
        self._bytes(count)

    def _integer(self, width: int) -> int:
        return int.from_bytes(self._bytes(width), "little")

    def _line(self) -> str:
        line = self.file.readline(1000)
        if not line.endswith(b"\n"):
            raise PickleError("the pickle is cut off")
        return line[:-1].decode()

    def _pop(self) -> Any:
        if not self._stack or self._stack[-1] is _MARK:
            raise PickleError("an opcode lacks its operand")
        return self._stack.pop()

    def _top(self) -> Any:
        value = self._pop()
        self._stack.append(value)
        return value

    def _push(self, value: Any) -> None:
        self._stack.append(value)

    def _to_mark(self) -> list[Any]:
        for place in range(len(self._stack) - 1, -1, -1):
            if self._stack[place] is _MARK:
                items = self._stack[place + 1 :]
                del self._stack[place:]
                return items
        raise PickleError("a mark is missing")

    def _put(self, index: int) -> None:
        self._memo[index] = self._top()

    def _get(self, index: int) -> None:
        if index not in self._memo:
            raise PickleError(f"nothing is stored under {index}")
        self._push(self._memo[index])

    def _global(self, module: Any, name: Any) -> None:
        if not (isinstance(module, str) and isinstance(name, str)):
            raise PickleError("a name is not a text")
        self._push(Global(module, name))

    def _call(self, function: Any, arguments: Any) -> None:
        if isinstance(function, Placeholder):  # a call of what an unknown call returned, such as getattr(…)
            self._push(function)
        elif isinstance(function, Global) and isinstance(arguments, tuple):
            self._push(self.call(function, arguments))
        else:
            raise PickleError("a call of something that is not a function")

    def _reduce(self) -> None:
        arguments = self._pop()
        self._call(self._pop(), arguments)

    def _newobj_ex(self) -> None:
        self._pop()  # keyword arguments
        self._reduce()

    def _append(self, items: list[Any]) -> None:
        target = self._top()
        if isinstance(target, list):
            target += items
        elif not isinstance(target, Placeholder):
            raise PickleError("elements for something that is not a list")

    def _set_items(self, items: list[Any]) -> None:
        target = self._top()
        if len(items) % 2 or not isinstance(target, dict | Placeholder):
            raise PickleError("entries for something that is not a dict")
        for key, value in zip(items[::2], items[1::2], strict=True):
            # Other keys, such as nested tuples, may take for ever to hash; nothing that is read has such keys.
            if isinstance(target, dict) and isinstance(key, _KEYS):
                target[key] = value

    def _add_items(self) -> None:
        self._to_mark()
        if not isinstance(self._top(), Placeholder):
            raise PickleError("elements for something that is not a set")

    def _persistent(self) -> None:
        if self.persistent is None:
            raise PickleError("a persistent id outside of a PyTorch file")
        self._push(self.persistent(self._pop()))

    def _long(self, width: int) -> None:
        self._push(int.from_bytes(self._bytes(self._integer(width)), "little", signed=True))

    def _protocol(self) -> None:
        if self._integer(1) > 5:
            raise PickleError("an unknown protocol")

    def _set_of_mark(self) -> None:
        self._to_mark()
        self._push(Placeholder(Global("builtins", "frozenset")))

    def _swapped_global(self) -> None:
        name = self._pop()
        self._global(self._pop(), name)


def read_pickle(data: bytes, **options: Any) -> Any:
    """The object in a pickle; options as those of `PickleReader`. Raises PickleError."""
    return PickleReader(io.BytesIO(data), **options).read()


def _tuple(count: int) -> Callable[[PickleReader], None]:
    def make(reader: PickleReader) -> None:
        items = [reader._pop() for _ in range(count)]
        reader._push(tuple(reversed(items)))

    return make


def _constant(make: Callable[[], Any]) -> Callable[[PickleReader], None]:
    return lambda reader: reader._push(make())


def _text(width: int) -> Callable[[PickleReader], None]:
    return lambda reader: reader._push(reader._bytes(reader._integer(width)).decode("utf-8", "surrogatepass"))


def _old_text(width: int) -> Callable[[PickleReader], None]:
    return lambda reader: reader._push(reader._bytes(reader._integer(width)).decode("utf-8", "replace"))


def _bytes_of(width: int) -> Callable[[PickleReader], None]:
    return lambda reader: reader._push(reader._bytes(reader._integer(width)))


def _number(pattern: str) -> Callable[[PickleReader], None]:
    size = struct.calcsize(pattern)
    return lambda reader: reader._push(struct.unpack(pattern, reader._bytes(size))[0])


_HANDLERS: dict[bytes, Callable[[PickleReader], None]] = {
    b"\x80": PickleReader._protocol,
    b"\x95": lambda reader: reader._skip(8),  # FRAME: only a hint for buffering
    b"(": lambda reader: reader._push(_MARK),
    b"0": lambda reader: reader._pop() and None,
    b"N": _constant(lambda: None),
    b"\x88": _constant(lambda: True),
    b"\x89": _constant(lambda: False),
    b"J": _number("<i"),
    b"K": _number("<B"),
    b"M": _number("<H"),
    b"G": _number(">d"),
    b"\x8a": lambda reader: reader._long(1),
    b"\x8b": lambda reader: reader._long(4),
    b"X": _text(4),
    b"\x8c": _text(1),
    b"\x8d": _text(8),
    b"T": _old_text(4),
    b"U": _old_text(1),
    b"B": _bytes_of(4),
    b"C": _bytes_of(1),
    b"\x8e": _bytes_of(8),
    b")": _constant(tuple),
    b"]": _constant(list),
    b"}": _constant(dict),
    b"\x8f": _constant(lambda: Placeholder(Global("builtins", "set"))),
    b"\x90": PickleReader._add_items,
    b"\x91": PickleReader._set_of_mark,
    b"\x85": _tuple(1),
    b"\x86": _tuple(2),
    b"\x87": _tuple(3),
    b"t": lambda reader: reader._push(tuple(reader._to_mark())),
    b"a": lambda reader: reader._append([reader._pop()]),
    b"e": lambda reader: reader._append(reader._to_mark()),
    b"s": lambda reader: reader._set_items([reader._pop(), reader._pop()][::-1]),
    b"u": lambda reader: reader._set_items(reader._to_mark()),
    b"q": lambda reader: reader._put(reader._integer(1)),
    b"r": lambda reader: reader._put(reader._integer(4)),
    b"\x94": lambda reader: reader._put(len(reader._memo)),
    b"h": lambda reader: reader._get(reader._integer(1)),
    b"j": lambda reader: reader._get(reader._integer(4)),
    b"c": lambda reader: reader._global(reader._line(), reader._line()),
    b"\x93": PickleReader._swapped_global,
    b"R": PickleReader._reduce,
    b"\x81": PickleReader._reduce,  # NEWOBJ: a class and its arguments
    b"\x92": PickleReader._newobj_ex,
    b"b": lambda reader: reader._pop() and None,  # BUILD: attributes are left out
    b"Q": PickleReader._persistent,
}
