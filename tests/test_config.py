"""Model files: what they say, and one clear line for each mistake in them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from bevcli.config import known_models, load_config, parse_config
from bevcli.errors import ConfigError


@dataclass(frozen=True)
class Wheel:
    width: float
    kind: Literal["summer", "winter"] = "summer"


@dataclass(frozen=True)
class Car:
    name: str
    wheel: Wheel
    seats: int = 4
    doors: tuple[int, ...] = ()
    size: tuple[float, float] = (4.0, 2.0)
    roof: Literal["open"] | tuple[float, float] = "open"
    towed: tuple[int, int] | None = None
    spare: Wheel = field(default_factory=lambda: Wheel(1.0))
    electric: bool = False

    def __post_init__(self) -> None:
        if self.seats < 1:
            raise ValueError("seats must be positive")


def parse(text: str) -> Car:
    return parse_config(text, "car.toml", Car)


MINIMAL = 'name = "a"\n{}\n[wheel]\nwidth = 1'


def test_the_published_models_come_with_the_package() -> None:
    assert {"tiny", "small", "base"} <= set(known_models())


@pytest.mark.parametrize(
    ("name", "cells", "layers", "levels", "padded"),
    [("tiny", 50, 3, 1, (800, 480)), ("small", 150, 3, 1, (1280, 736)), ("base", 200, 6, 4, (1600, 928))],
)
def test_the_published_models_are_as_published(
    name: str, cells: int, layers: int, levels: int, padded: tuple[int, int]
) -> None:
    config = load_config(name)
    assert (config.bev_grid.rows, config.bev_grid.columns) == (cells, cells)
    assert (config.encoder.layers, config.neck.levels, config.image.padded_size) == (layers, levels, padded)
    assert config.name == name
    assert config.ego_motion.history_shift == "both"


def test_a_path_to_a_copy_gives_the_same_model(tmp_path: Path) -> None:
    copy = tmp_path / "mine.toml"
    source = Path(__file__).parents[1] / "bevcli" / "configs" / "tiny.toml"
    copy.write_text(source.read_text())
    assert load_config(copy) == load_config("tiny")


def test_values_take_the_dataclasss_types() -> None:
    car = parse('name = "a"\ndoors = [2, 3]\nsize = [4, 2.5]\nroof = [1, 2]\ntowed = [1, 1]\nwheel = { width = 3 }')
    assert car == Car("a", Wheel(3.0), doors=(2, 3), size=(4.0, 2.5), roof=(1.0, 2.0), towed=(1, 1))
    assert isinstance(car.wheel.width, float)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (MINIMAL.format("seets = 3"), 'car.toml: unknown key "seets"; did you mean "seats"?'),
        (MINIMAL.format("") + "\nwidht = 2", 'car.toml: unknown key "wheel.widht"; did you mean "width"?'),
        ('name = "a"', 'car.toml: "wheel" is missing; expected a table'),
        (MINIMAL.format("seats = 2.5"), 'car.toml: "seats" must be a whole number, but is 2.5'),
        (MINIMAL.format("seats = true"), 'car.toml: "seats" must be a whole number, but is True'),
        (MINIMAL.format("electric = 1"), 'car.toml: "electric" must be true or false, but is 1'),
        (MINIMAL.format("size = [1.0]"), 'car.toml: "size" must be a list of 2, each element a number, but is [1.0]'),
        (MINIMAL.format("size = [1, nan]"), '"size" must be a list of 2, each element a number, but is [1, nan]'),
        (MINIMAL.format('doors = ["x"]'), "\"doors\" must be a list, each element a whole number, but is ['x']"),
        (MINIMAL.format('roof = "shut"'), '"roof" must be "open" or a list of 2, each element a number'),
        (MINIMAL.format("wheel2 = 1"), 'unknown key "wheel2"; did you mean "wheel"?'),
        ('name = "a"\nwheel = 3', 'car.toml: "wheel" must be a table, but is 3'),
        (MINIMAL.format("") + '\nkind = "all"', '"wheel.kind" must be "summer" or "winter", but is \'all\''),
        (MINIMAL.format("seats = 0"), "car.toml: seats must be positive"),
        ("name = ", "car.toml: is no valid TOML"),
    ],
)
def test_a_mistake_gets_one_line_that_names_file_and_key(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(text)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("channels = 256", "channels = 250", "channels is 250"),
        ("spatial_points = 8", "spatial_points = 6", "encoder.spatial_points must be a multiple"),
        ("levels = 1", "levels = 5", "neck.levels is 5"),
        ("output_stages = [4]", "output_stages = [5]", "[backbone]: output_stages"),
        ("rows = 50", "rows = 0", "at least one row"),
        ("attention_heads = 8", "attention_heads = 0", "[encoder]: layers, heads"),
        ("queries = 900", "queries = 0", "[decoder]: layers, heads"),
        ("x_range_m = [-51.2, 51.2]", "x_range_m = [51.2, -51.2]", "each range goes from a smaller"),
        ("rate_hz = 2.0", "rate_hz = 0", "rate_hz and max_gap_s must be positive"),
        ("blocks = [3, 4, 6, 3]", "blocks = [3, 0, 6, 3]", "[backbone]: blocks"),
        ('heads = ["detection"]', 'heads = ["detektion"]', '"heads" must be'),
        ("queries = 900", "querys = 900", 'unknown key "decoder.querys"; did you mean "queries"?'),
    ],
)
def test_parts_of_a_model_that_do_not_fit_each_other_are_named(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    text = (Path(__file__).parents[1] / "bevcli" / "configs" / "tiny.toml").read_text()
    assert old in text
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(old, new))
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert message in str(caught.value)
    assert "mine.toml" in str(caught.value)


@pytest.mark.parametrize("name", ["huge", "nowhere/x.toml"])
def test_an_unknown_model_names_the_known_ones(name: str) -> None:
    with pytest.raises(ConfigError, match=r"base.*small.*tiny"):
        load_config(name)


def test_a_file_that_is_no_text_is_named(tmp_path: Path) -> None:
    path = tmp_path / "bytes.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"bytes\.toml: cannot be read"):
        load_config(path)
