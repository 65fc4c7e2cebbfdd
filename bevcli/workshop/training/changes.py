"""Changes of single settings of the [training] table, as `bevcli train --set` takes them."""

import dataclasses
import difflib
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

from bevcli.config import TRAINING, settings_of_table
from bevcli.errors import ConfigError

T = TypeVar("T")


def with_changes(config: T, changes: Mapping[str, str]) -> T:
    """The settings with some of them changed.

    config: the dataclass of [training].
    changes: values by key, such as {"optimizer.learning_rate": "1e-4"}, as in TOML; a text may lack its quotes.
    Raises ConfigError for an unknown key, which names the nearest, or a wrong value.
    """
    table: dict[str, Any] = dataclasses.asdict(config)  # type: ignore[call-overload]
    known = list(_keys(config))
    for key, text in changes.items():
        key = key.removeprefix(f"{TRAINING}.")
        if key not in known:
            raise ConfigError(f'`changes`: unknown key "{key:.100}"; {_nearest(key, known)}')
        *tables, name = key.split(".")
        inner = table
        for each in tables:
            inner = inner[each]
        inner[name] = _value(text)
    return settings_of_table({TRAINING: table}, TRAINING, type(config), "`changes`")


def _keys(config: Any, prefix: str = "") -> Iterator[str]:
    """The keys of a dataclass with the names of their tables, as "clips.batch"."""
    for name, value in vars(config).items():
        if dataclasses.is_dataclass(value):
            yield from _keys(value, f"{prefix}{name}.")
        else:
            yield prefix + name


def _value(text: str) -> Any:
    """The value of a text in TOML; the text itself where it is none."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (tomllib.TOMLDecodeError, KeyError):
        return text


def _nearest(key: str, known: list[str]) -> str:
    """The key with the most similar name or, without its table, with the most similar last part."""
    last = {name.rpartition(".")[2]: name for name in reversed(known)}
    found = difflib.get_close_matches(key, known, 1) or [last[name] for name in difflib.get_close_matches(key, last, 1)]
    return f'did you mean "{found[0]}"?' if found else "the keys are in the table of docs/training.md"
