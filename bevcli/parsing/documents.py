"""JSON, TOML, YAML and XML with limits on nesting and on the size of numbers.

Parsers refuse a broken text, but many well-formed texts break the code behind them: lists nested a thousand levels
deep, integers that no array can hold, YAML objects that contain themselves. They are refused here, for all
readers.
"""

import gc
import json
import re
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
import yaml

from bevcli.errors import BevcliError, InputError
from bevcli.parsing.files import MIB, read_bytes, read_text
from bevcli.printing import reason_of

DEEPEST = 64  # levels of nested lists and objects
LARGEST_INTEGER = 2**62  # the difference of two such integers still fits 64 bits
JSON_BYTES, TOML_BYTES, YAML_BYTES = 64 * MIB, MIB, MIB // 4
MOST_VALUES = 200_000  # of a TOML or YAML file
_BRACKETS = b"[]{}"
_NO_BRACKETS = bytes(set(range(256)) - set(_BRACKETS))
_DIGITS_TO_ZERO = bytes.maketrans(b"123456789", b"000000000")
_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _YamlLoader(_SafeLoader):
    """The safe loader, which makes no Python objects, and reads OpenCV's matrices as mappings."""


_YamlLoader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, deep=True)
)


def read_json(
    path: Path,
    *,
    largest: int = JSON_BYTES,
    missing: str = "the file is missing",
    pairs: Callable[[list[tuple[str, Any]]], Any] | None = None,
) -> Any:
    """The contents of a JSON file. Raises InputError.

    Args:
        path: the file.
        largest: its largest size in bytes.
        missing: text of the message for a file that is not there.
        pairs: makes an object of its keys and values, in place of a dict.
    """
    return parse_json(read_bytes(path, largest, missing=missing), path, pairs=pairs)


def parse_json(text: bytes, path: Path, *, pairs: Callable[[list[tuple[str, Any]]], Any] | None = None) -> Any:
    """Parses JSON: at most 64 nested levels, integers of at most 62 bits. Raises InputError, which names `path`."""
    if _depth_bound(text) > DEEPEST and _exact_depth(text) > DEEPEST:
        raise InputError(f"{path}: is nested too deeply (expected at most {DEEPEST} levels of lists and objects)")

    def integer(digits: str) -> int:
        if len(digits) > 20 or abs(int(digits)) > LARGEST_INTEGER:
            raise InputError(f"{path}: the integer {digits:.24} is too large (expected at most 62 bits)")
        return int(digits)

    # A Python function for integers makes parsing slow, and only a long row of digits needs it.
    long_number = b"0" * 19 in text.translate(_DIGITS_TO_ZERO)
    try:
        document = json.loads(text, object_pairs_hook=pairs, parse_int=integer if long_number else None)
        if b"\\u" in text:  # an escape may be half of a character, which no file or terminal takes
            json.dumps(document, ensure_ascii=False, default=vars).encode()
        return document
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise InputError(f"{path}: {where}: broken JSON: {error.msg}") from None
    except UnicodeError as error:
        raise InputError(f"{path}: cannot be read as JSON ({reason_of(error)[:200]})") from None
    except RecursionError:
        raise InputError(f"{path}: is nested too deeply to be read as JSON") from None


def parse_xml(text: bytes, path: Path) -> ElementTree.Element:
    """The root of an XML document without entities of its own. Raises InputError, which names `path`.

    A few short entities can stand for gigabytes of text. None is read from another file.
    """

    def refuse(name: str, *declaration: object) -> None:
        raise InputError(f"{path}: declares the entity {name:.40} (expected XML without entities)")

    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler, parser.EntityDeclHandler = builder.data, refuse
    parser.buffer_text = True
    try:
        parser.Parse(text, True)
        return builder.close()
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise InputError(f"{path}: broken XML: {reason_of(error)[:200]}") from None


def parse_toml(text: str, path: str | Path, error: type[BevcliError] = InputError) -> dict[str, Any]:
    """Parses TOML. Raises `error`, which names `path`."""
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as failure:
        raise error(f"{path}: invalid TOML: {failure}") from None
    except (ValueError, RecursionError, OverflowError) as failure:  # impossible dates, thousands of digits or brackets
        raise error(f"{path}: cannot be read as TOML ({reason_of(failure)[:200]})") from None
    check_values(document, path, error)
    return document


def read_yaml(path: Path) -> Any:
    """The contents of a YAML file with plain values. Raises InputError."""
    text = re.sub(r"\A%YAML:.*", "", read_text(path, YAML_BYTES))  # OpenCV's header, which is not YAML
    try:
        _check_yaml_depth(text, path)
        document = yaml.load(text, _YamlLoader)
    except yaml.YAMLError as error:
        raise InputError(f"{path}: broken YAML ({reason_of(error)[:200]})") from None
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError, OverflowError) as error:
        raise InputError(f"{path}: cannot be read as YAML ({reason_of(error)[:200]})") from None
    check_values(document, path)
    return document


def check_values(document: Any, path: str | Path, error: type[BevcliError] = InputError) -> None:
    """Raises `error` where a parsed document is nested too deeply or contains an integer beyond 62 bits."""
    level = [document]
    count = 0
    for _ in range(DEEPEST + 1):
        below: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                below += [*value.keys(), *value.values()]
            elif isinstance(value, list | tuple | set):
                below += value
            elif isinstance(value, int) and abs(value) > LARGEST_INTEGER:
                raise error(f"{path}: an integer is too large (expected at most 62 bits)")
            if len(below) > MOST_VALUES:
                break
        if not below:
            return
        count += len(below)
        if count > MOST_VALUES:  # YAML's aliases can repeat a list in a list in a list
            raise error(f"{path}: has more than {MOST_VALUES} values, aliases written out")
        level = below
    raise error(f"{path}: is nested too deeply (expected at most {DEEPEST} levels)")


def _check_yaml_depth(text: str, path: Path) -> None:
    depth = 0
    for event in yaml.parse(text, _YamlLoader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise InputError(f"{path}: is nested too deeply (expected at most {DEEPEST} levels)")


def _depth_bound(text: bytes) -> int:
    """The deepest nesting of brackets, those in strings included."""
    brackets = np.frombuffer(text.translate(None, _NO_BRACKETS), dtype=np.uint8)
    if not len(brackets):
        return 0
    opening = (brackets == ord("[")) | (brackets == ord("{"))
    return int(np.cumsum(np.where(opening, 1, -1), dtype=np.int32).max())


def _exact_depth(text: bytes) -> int:
    """The deepest nesting of brackets outside of strings."""
    return _depth_bound(re.sub(rb'"(?:[^"\\]|\\.)*+"', b"", text, flags=re.DOTALL))


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Inside the block, the collector does not run: it would scan all parsed JSON objects again and again.

    Without it, reading a boxes file takes half the time, and nuScenes tables two thirds.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
