"""docs/training.md names every key of the [training] table, with its default."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import bevcli
from bevcli.training.job import TrainingConfig

DOCUMENT = Path(bevcli.__file__).parents[1] / "docs" / "training.md"


def keys(config: object) -> Iterator[tuple[str, object]]:
    for field in dataclasses.fields(config):  # type: ignore[arg-type]
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from keys(value)
        else:
            yield field.name, value


def test_every_key_and_its_default_stand_in_the_table() -> None:
    rows = [line for line in DOCUMENT.read_text().splitlines() if line.startswith("|")]
    for name, value in keys(TrainingConfig()):
        said = [row for row in rows if f"{name}`" in row]
        assert len(said) >= 1, name
        text = {0.001: "1e-3", 2e-4: "2e-4", 1 / 3: "1/3"}.get(
            value, f"{value:g}" if type(value) is float else str(value)
        )
        assert any(text.lower() in row.lower() for row in said), (name, text)
