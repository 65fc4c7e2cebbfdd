"""Reads TOML files into frozen dataclasses. An unknown key or a wrong type is an error that names file and key."""

import dataclasses
import json
import math
import os
import re
import types
import typing
from collections.abc import Mapping
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec

from bevcli.errors import ConfigError
from bevcli.geometry.object_classes import ClassSettings
from bevcli.model.config import ModelConfig
from bevcli.model.temporal_model import TemporalModel
from bevcli.parsing.documents import TOML_BYTES, parse_toml
from bevcli.parsing.files import read_text
from bevcli.printing import did_you_mean
from bevcli.published import hub_model, read_sources
from bevcli.registry import entries, is_of_hub, known_models, load

T = TypeVar("T")

# The key that names the registered model that a file configures. A file without it configures a BEVFormer.
ARCHITECTURE = "architecture"

TRACKING = "tracking"  # the table of a model's file with the parameters of the tracker
TRAINING = "training"  # the table of a model's file with the settings of its training, which the model does not need


def load_config(name_or_path: str | Path) -> ModelConfig:
    """The configuration of a known model ("tiny"), of published weights ("tiny-fp16"), or of a FILE.toml.

    Raises ConfigError where there is none, or where its contents are wrong.
    """
    return config_of_table(*read_model_file(str(name_or_path)))


def config_of_table(table: dict[str, Any], file: str) -> ModelConfig:
    """The configuration in the parsed contents of a model's file. Raises ConfigError, which names `file`.

    Paths of meshes are relative to the folder of `file`.
    """
    architecture, architectures = table.get(ARCHITECTURE, ModelConfig.architecture), list(entries("bevcli.models"))
    if architecture not in architectures:
        expected = " or ".join(f'"{name}"' for name in architectures)
        raise ConfigError(f'{file}: "{ARCHITECTURE}" must be {expected}, but is {architecture!r:.60}')
    settings = {key: table[key] for key in table if key not in (TRACKING, TRAINING, ARCHITECTURE)}
    model: type[TemporalModel] = load("bevcli.models", architecture)
    config = _dataclass(settings, model.config_class, file, "")
    if not re.fullmatch(r"[\w][\w. +-]{0,99}", config.name):
        expected = "up to 100 letters, digits and - . + _, because it names folders"
        raise ConfigError(f'{file}: "name" is {config.name!r:.60} (expected {expected})')
    classes, folder = config.class_settings.items(), Path(file).parent
    from_here = {name: replace(item, mesh=item.mesh and str(folder / item.mesh)) for name, item in classes}
    return replace(config, class_settings=from_here)


def load_table(name_or_path: str | Path, table: str, cls: type[T]) -> T:
    """A table of a model's file, TRACKING or TRAINING, as a dataclass of type `cls`; its defaults without the table.

    Raises ConfigError where there is no such file, or where its contents are wrong.
    """
    contents, file = read_model_file(str(name_or_path))
    return settings_of_table(contents, table, cls, file)


def settings_of_table(contents: dict[str, Any], table: str, cls: type[T], file: str) -> T:
    """A table in the parsed contents of a model's file, as `load_table`. Raises ConfigError, which names `file`."""
    settings = contents.get(table, {})
    if not isinstance(settings, dict):
        raise ConfigError(f'{file}: "{table}" must be a table, but is {settings!r:.60}')
    return _dataclass(settings, cls, file, f"{table}.")


def as_table(config: ModelConfig, tracking: object = None) -> dict[str, Any]:
    """The contents of the file of a model, from which `config_of_table` makes the same configuration without meshes.

    tracking: the dataclass of the table TRACKING; None for no such table.
    """
    portable = {name: replace(settings, mesh=None) for name, settings in config.class_settings.items()}
    changed = {name: settings for name, settings in portable.items() if settings != ClassSettings()}
    table = {ARCHITECTURE: config.architecture, **_plain(replace(config, class_settings=changed))}
    return table if tracking is None else table | {TRACKING: _plain(tracking)}


def as_toml(table: Mapping[str, Any], prefix: str = "") -> str:
    """A table as TOML: its values first, then the tables in it."""
    lines = [f"{_key(key)} = {_json(value)}" for key, value in table.items() if not isinstance(value, Mapping)]
    for key, value in table.items():
        if isinstance(value, Mapping):
            name = f"{prefix}{_key(key)}"
            lines += ["", f"[{name}]", as_toml(value, f"{name}.").rstrip("\n")]
    return "\n".join(lines) + "\n"


def _json(value: Any) -> str:
    """A text, number, truth value or list in TOML, which writes these as JSON does."""
    return json.dumps(value, ensure_ascii=False)


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _json(name)


def _plain(settings: Any) -> dict[str, Any]:
    """The fields of a dataclass as TOML has them: nested dictionaries; lists for tuples; None is left out."""
    table = settings if isinstance(settings, dict) else msgspec.to_builtins(settings)
    return {
        key: _plain(value) if isinstance(value, dict) else value for key, value in table.items() if value is not None
    }


def read_model_file(name: str) -> tuple[dict[str, Any], str]:
    """Contents and name of the TOML file of a model. This is the one place that knows what the name of a model means.

    name: a known model; a name of the table of published weights, whose model gets that name; a FILE.toml; or a model
        of a hub, such as "hf:OWNER/NAME".
    Raises ConfigError where there is no such file, or where it is no TOML, and WeightsError for a hub.
    """
    if is_of_hub(name):
        of_hub = hub_model(name)
        return dict(of_hub.contents), str(of_hub.file)
    models, published = known_models(), {}
    own_weights = resources.files("bevcli").joinpath("weights", f"{name}.safetensors")
    has_own_weights = name in models and own_weights.is_file()  # no other name is looked up: it may be too long for one
    if not name.endswith(".toml") and not has_own_weights:  # a name of the package is not in the table
        published = read_sources()
    of_weights = published[name].model if name in published else ""
    file = model = of_weights or name
    if model.endswith(".toml"):
        if not os.path.isfile(model):  # also where the name is too long
            raise ConfigError(f"{model}: file not found; known models are {', '.join(models)}")
        text = read_text(Path(model), TOML_BYTES, error=ConfigError)
    else:
        if model not in models:
            names = ", ".join(dict.fromkeys([*models, *published]))
            packed = f'; the folder is named "hf:./{model}"' if os.path.isdir(model) else ""
            raise ConfigError(f'unknown model "{model}"; expected one of {names}, or a FILE.toml{packed}')
        file = f"{model}.toml"
        text = resources.files("bevcli").joinpath("configs", file).read_text(encoding="utf-8")
    contents = parse_toml(text, file, ConfigError)
    return contents | {"name": name} if of_weights else contents, file


def _dataclass(table: dict[str, Any], cls: type[T], file: str, prefix: str) -> T:
    fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    hints = typing.get_type_hints(cls, include_extras=True)
    for key in table.keys() - fields.keys():
        hint = did_you_mean(key, fields, f"expected one of {', '.join(fields)}", '"')
        raise ConfigError(f'{file}: unknown key "{prefix}{key}"; {hint}')
    values = {key: _value(value, hints[key], file, prefix + key) for key, value in table.items()}
    for name, field in fields.items():
        optional = field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING
        if name not in values and not optional:
            raise ConfigError(f'{file}: "{prefix}{name}" is missing; expected {_describe(hints[name])}')
    try:
        return cls(**values)
    except ValueError as error:
        location = f"[{prefix[:-1]}]: " if prefix else ""
        raise ConfigError(f"{file}: {location}{error}") from error


def _value(value: Any, hint: Any, file: str, key: str) -> Any:
    if dataclasses.is_dataclass(hint) and isinstance(value, dict):
        return _dataclass(value, typing.cast(type, hint), file, f"{key}.")
    kinds: dict[str, Any] = {member.kind: member for member in typing.get_args(hint) if hasattr(member, "kind")}
    if kinds and isinstance(value, dict):
        kind = value.get("kind", next(iter(kinds)))
        if kind not in [*kinds]:  # a list or a table has no hash
            raise ConfigError(f'{file}: "{key}.kind" must be {_describe(Literal[*kinds])}, but is {kind!r:.60}')
        return _dataclass(value, kinds[kind], file, f"{key}.")
    if typing.get_origin(hint) is Mapping and isinstance(value, dict):
        return {name: _value(item, typing.get_args(hint)[1], file, f"{key}.{name}") for name, item in value.items()}
    try:
        if not kinds and _is_finite(value):
            return msgspec.convert(value, hint)
    except msgspec.ValidationError:
        pass
    raise ConfigError(f'{file}: "{key}" must be {_describe(hint)}, but is {value!r}')


def _is_finite(value: Any) -> bool:
    """False for NaN and infinity, also in a list."""
    if isinstance(value, list):
        return all(map(_is_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def _describe(hint: Any) -> str:
    """A type in words, for an error message."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return " or ".join(f'"{argument}"' for argument in arguments)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(_describe(argument) for argument in arguments if argument is not type(None)))
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return f"a list, each element {_describe(arguments[0])}"
        return f"a list of {len(arguments)}, each element {_describe(arguments[0])}"
    if origin is Annotated:
        kind, limits = _describe(arguments[0]), arguments[1]
        if limits.gt is not None:
            return f"{kind} above {limits.gt:g}"
        if limits.lt is not None:
            return f"{kind} from {limits.ge:g} to below {limits.lt:g}"
        return (
            f"{kind} of {limits.ge:g} or more" if limits.le is None else f"{kind} from {limits.ge:g} to {limits.le:g}"
        )
    names = {bool: "true or false", int: "an integer", float: "a number", str: "a string"}
    return names.get(hint, "a table")
