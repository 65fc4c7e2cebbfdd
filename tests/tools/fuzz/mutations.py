"""Breaks a file: changes of bytes, of words in a text, and of values in a JSON document."""

import json
import re
import struct
from typing import Any

from hypothesis import strategies as st

# One change: what, where and with what; the numbers are taken modulo what there is.
Edit = tuple[str, int, int]
BYTES = ("flip", "set", "cut", "repeat", "remove", "insert", "number")
TEXT = ("word", "word", "swap")
TREE = ("value", "value", "drop", "nest", "copy")
KINDS = {"bytes": BYTES, "text": TEXT * 3 + BYTES, "json": TREE * 4 + TEXT * 2 + BYTES}

ODD_BYTES = (
    b"\x00",
    b"\xff" * 8,
    b"\n" * 3,
    b"{" * 9,
    b"[" * 5000,
    b"\xf0\x9f\x98\x80",
    b"\xc3\x28",
    b'"',
    b"9" * 5000,
)
ODD_NUMBERS = (0, 1, -1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 20, 1 << 31)
ODD_WORDS = (
    b"", b"0", b"-1", b"nan", b"inf", b"-inf", b"1e308", b"1e400", b"9" * 19, b"-" + b"9" * 25, b"9" * 4400, b"1.5",
    b"true", b"null", b"[]", b"{}", b"../../etc/passwd", b"/dev/zero", b"/etc",
    b"a#99999999999999999999", b"2001-99-99",
    b"x" * 3000, b"&a [*a]", b"!!python/object/apply:os.system [true]", b"0x7fffffffffffffffff",
    b"1:2:3:4", b"<<", b"~",
    b"\x00", b"\xe2\x80\xae", b"[" * 2000, b"1_0", b"'", b"=", b"1e-320", b"\xc2\xb2",
)  # fmt: skip
ODD_VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 1.5, -0.0, 1e308, 1e-320, float("nan"), float("inf"), 2**31, 2**53, 2**63, 10**25, "",
    "x", "../../x", "x" * 3000, "\x00", "\ud800", "²", [], {}, [[]], [None], [1], [1, 2], [1, [2]], ["a", "b", "c"],
    {"": None}, {"a": {"b": 1}}, [1e300, 1e300, 1e300], [0, 0, 0, 0], [2**70, 0, 0], list(range(2000)),
    [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
)  # fmt: skip
WORD = re.compile(rb'"[^"\n]*"|[-+.\w#/]+')


def edits(kind: str) -> st.SearchStrategy[list[Edit]]:
    """One to four changes of a file; kind: "bytes", "text" or "json"."""
    number = st.integers(0, 2**32 - 1)
    return st.lists(st.tuples(st.sampled_from(KINDS[kind]), number, number), min_size=1, max_size=4)


def mutated(seed: bytes, changes: list[Edit]) -> bytes:
    """The file after the changes. A change that does not apply, such as one of a broken document, is left out."""
    for name, where, what in changes:
        seed = _changed(seed, name, where, what)
    return seed


def _changed(data: bytes, name: str, where: int, what: int) -> bytes:
    if name in TREE:
        return changed_tree(data, name, where, what)
    if name in TEXT:
        return _changed_text(data, name, where, what)
    place = where % (len(data) + 1)
    end = min(len(data), place + what % 40 + 1)
    new = {
        "flip": bytes(byte ^ (1 << what % 8) for byte in data[place : place + 1]),
        "set": struct.pack("<I", what)[: len(data[place:end]) % 4 + 1],
        "repeat": data[place:end] * (what % 50),
        "insert": ODD_BYTES[what % len(ODD_BYTES)],
        "number": struct.pack("<>"[what % 2] + "q", ODD_NUMBERS[what % len(ODD_NUMBERS)])[: 4 if what % 3 else 8],
    }
    if name == "cut":
        return data[:place]
    if name in ("remove", "repeat"):
        return data[:place] + new.get("repeat" if name == "repeat" else "", b"") + data[end:]
    if name == "insert":
        return data[:place] + new[name] + data[place:]
    return data[:place] + new[name] + data[place + len(new[name]) :]


def _changed_text(data: bytes, name: str, where: int, what: int) -> bytes:
    words = list(WORD.finditer(data))
    if not words:
        return data
    word = words[where % len(words)]
    if name == "swap":
        new = words[what % len(words)].group()
    else:
        new = ODD_WORDS[what % len(ODD_WORDS)]
    return data[: word.start()] + new + data[word.end() :]


def changed_tree(data: bytes, name: str, where: int, what: int) -> bytes:
    """A JSON document after one change of TREE; one that cannot be parsed stays as it is."""
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        return data
    slots = list(_slots(document))
    if not slots:
        return data
    owner, key = slots[where % len(slots)]
    if name == "drop":
        del owner[key]
    elif name == "nest":
        value = owner[key]
        for _ in range(what % 300):
            value = [value] if what % 2 else {"a": value}
        owner[key] = value
    elif name == "copy":
        other, other_key = slots[what % len(slots)]
        owner[key] = json.loads(json.dumps(other[other_key]))
    else:
        owner[key] = ODD_VALUES[what % len(ODD_VALUES)]
    return json.dumps(document).encode("utf-8", "surrogatepass")


def _slots(value: Any) -> Any:
    """Every place of a value in a document: its owner and key."""
    keys = value.keys() if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    for key in list(keys):
        yield value, key
        yield from _slots(value[key])
