"""Reads TOML files into frozen dataclasses. An unknown key or a wrong type is an error that names file and key."""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import types
import typing
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, Literal, TypeVar

from bevcli.errors import ConfigError
from bevcli.model.bevformer import BEVFormerConfig
from bevcli.model.bevformer_v2 import BEVFormerV2Config
from bevcli.model.uniad import UniADConfig
from bevcli.parsing.documents import TOML_BYTES, parse_toml
from bevcli.parsing.files import read_text

T = TypeVar("T")

# The key that says which model a file configures, and its values. A file without it configures a BEVFormer.
ARCHITECTURE = "architecture"
ARCHITECTURES: dict[str, type[BEVFormerConfig]] = {
    "BEVFormer": BEVFormerConfig,
    "BEVFormerV2": BEVFormerV2Config,
    "UniAD": UniADConfig,
}

TRACKING = "tracking"  # the table of a model's file with the parameters of the tracker
TRAINING = "training"  # the table of a model's file with the settings of its training, which the model does not need


def known_models() -> tuple[str, ...]:
    """The names of the models whose TOML files come with the package."""
    files = resources.files("bevcli").joinpath("configs").iterdir()
    return tuple(sorted(Path(file.name).stem for file in files if file.name.endswith(".toml")))


def load_config(name_or_path: str | Path) -> BEVFormerConfig:
    """The configuration of a known model ("tiny"), or of a file whose name ends in .toml.

    Raises ConfigError where there is none, or where its contents are wrong.
    """
    text, file = _read_model(str(name_or_path))
    table = _parse(text, file)
    architecture = table.get(ARCHITECTURE, "BEVFormer")
    if architecture not in list(ARCHITECTURES):
        expected = " or ".join(f'"{name}"' for name in ARCHITECTURES)
        raise ConfigError(f'{file}: "{ARCHITECTURE}" must be {expected}, but is {architecture!r:.60}')
    settings = {key: table[key] for key in table if key not in (TRACKING, TRAINING, ARCHITECTURE)}
    config = _dataclass(settings, ARCHITECTURES[architecture], file, "")
    if not re.fullmatch(r"[\w][\w. +-]{0,99}", config.name):
        expected = "up to 100 letters, digits and - . + _, because it names folders"
        raise ConfigError(f'{file}: "name" is {config.name!r:.60} (expected {expected})')
    return config


def load_table(name_or_path: str | Path, table: str, kind: type[T]) -> T:
    """A table of a model's file, TRACKING or TRAINING, as a dataclass of type `kind`; its defaults without the table.

    Raises ConfigError where there is no such file, or where its contents are wrong.
    """
    text, file = _read_model(str(name_or_path))
    return _dataclass(_parse(text, file).get(table, {}), kind, file, f"{table}.")


def _parse(text: str, file: str) -> dict[str, Any]:
    return parse_toml(text, file, ConfigError)


def _read_model(name: str) -> tuple[str, str]:
    """Text and name of the TOML file of a known model, or of a file whose name ends in .toml."""
    if name.endswith(".toml"):
        path = Path(name)
        if not path.is_file():
            raise ConfigError(f"{path}: file not found; known models are {', '.join(known_models())}")
        return _read(path), name
    if name not in known_models():
        known = ", ".join(known_models())
        raise ConfigError(f'unknown model "{name}"; expected one of {known}, or a FILE.toml')
    file = f"{name}.toml"
    return resources.files("bevcli").joinpath("configs", file).read_text(encoding="utf-8"), file


def _read(path: Path) -> str:
    return read_text(path, TOML_BYTES, error=ConfigError)


def _dataclass(table: dict[str, Any], kind: type[T], file: str, prefix: str) -> T:
    fields = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    hints = typing.get_type_hints(kind)
    for key in table.keys() - fields.keys():
        renamed: Mapping[str, str] = getattr(kind, "RENAMED_KEYS", {})
        hint = renamed[key] if key in renamed else _nearest(key, list(fields))
        raise ConfigError(f'{file}: unknown key "{prefix}{key}"; {hint}')
    values = {key: _value(value, hints[key], file, prefix + key) for key, value in table.items()}
    for name, field in fields.items():
        optional = field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING
        if name not in values and not optional:
            raise ConfigError(f'{file}: "{prefix}{name}" is missing; expected {_describe(hints[name])}')
    try:
        return kind(**values)
    except ValueError as error:
        where = f"[{prefix[:-1]}]: " if prefix else ""
        raise ConfigError(f"{file}: {where}{error}") from error


def _value(value: Any, kind: Any, file: str, key: str) -> Any:
    if dataclasses.is_dataclass(kind) and isinstance(value, dict):
        return _dataclass(value, typing.cast(type, kind), file, f"{key}.")
    if not _fits(value, kind):
        raise ConfigError(f'{file}: "{key}" must be {_describe(kind)}, but is {value!r}')
    return _converted(value, kind)


def _fits(value: Any, kind: Any) -> bool:
    """Whether a TOML value fits a type: a scalar, Literal, tuple, or a union of these."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return value in arguments and not isinstance(value, bool)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, argument) for argument in arguments)
    if origin is tuple:
        if not isinstance(value, list):
            return False
        kinds = _element_kinds(arguments, len(value))
        return len(kinds) == len(value) and all(map(_fits, value, kinds))
    if kind is float:
        return type(value) in (int, float) and math.isfinite(value)
    return type(value) is kind


def _converted(value: Any, kind: Any) -> Any:
    """A fitting value converted to a type: lists to tuples, integers to floats."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return _converted(value, next(argument for argument in arguments if _fits(value, argument)))
    if origin is tuple:
        return tuple(map(_converted, value, _element_kinds(arguments, len(value))))
    return float(value) if kind is float else value


def _element_kinds(arguments: tuple[Any, ...], length: int) -> tuple[Any, ...]:
    """The types of a tuple's elements; tuple[int, ...] has any length."""
    return (arguments[0],) * length if arguments[-1] is Ellipsis else arguments


def _describe(kind: Any) -> str:
    """A type in words, for an error message."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return " or ".join(f'"{argument}"' for argument in arguments)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_describe(argument) for argument in arguments if argument is not type(None))
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return f"a list, each element {_describe(arguments[0])}"
        return f"a list of {len(arguments)}, each element {_describe(arguments[0])}"
    names = {bool: "true or false", int: "an integer", float: "a number", str: "a string"}
    return names.get(kind, "a table")


def _nearest(key: str, known: list[str]) -> str:
    match = difflib.get_close_matches(key, known, n=1)
    return f'did you mean "{match[0]}"?' if match else f"expected one of {', '.join(known)}"
