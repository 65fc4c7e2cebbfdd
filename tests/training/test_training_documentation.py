"""docs/training.md lists every key of the [training] table with its default."""

import dataclasses
import re
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import bevcli
from bevcli.workshop.training.job import TrainingConfig

DOCS = Path(bevcli.__file__).parents[1] / "docs"


def defaults(config: object, table: str = "") -> Iterator[tuple[str, object]]:
    """Key, with the names of its tables, and default value."""
    for field in dataclasses.fields(config):  # type: ignore[arg-type]
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from defaults(value, f"{table}{field.name}.")
        else:
            yield f"{table}{field.name}", value


def documented() -> Iterator[tuple[str, object]]:
    """Key and default value of each entry of the document's table. A key ".name" is in the table of the key before."""
    section = (DOCS / "training.md").read_text().partition("## The `[training]` table")[2].partition("\n## ")[0]
    for row in re.findall(r"^\| (`.*?) \| (.*?) \|", section, flags=re.MULTILINE):
        table = ""
        for key, value in zip(row[0].split(", "), row[1].split(", "), strict=True):
            name = key.strip("`")
            name = table + name if name.startswith(".") else name
            table = name.rpartition(".")[0]
            yield name, parsed(value)


def parsed(value: str) -> object:
    if value.startswith('"'):
        return value.strip('"')
    if value in ("true", "false"):
        return value == "true"
    if " to " in value or "; " in value:  # a range, or a list
        return tuple(float(number) for number in re.split(" to |; ", value))
    return float(Fraction(value))


def test_the_table_lists_every_key_with_its_default() -> None:
    expected = {key: with_floats(value) for key, value in defaults(TrainingConfig())}
    assert dict(documented()) == expected


def with_floats(value: object) -> object:
    if isinstance(value, tuple):
        return tuple(float(number) for number in value)
    return float(value) if type(value) in (int, float) else value
