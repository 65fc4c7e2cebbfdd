"""A model file for benchmarks that take seconds."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import pytest

SMALL = {
    "size = [800, 450]": "size = [160, 90]",
    "rows = 50": "rows = 12",
    "columns = 50": "columns = 10",
    "channels = 256": "channels = 32",
    "blocks = [3, 4, 6, 3]": "blocks = [1, 1, 1, 1]\nwidth = 8",
    "queries = 900": "queries = 30",
}


@pytest.fixture
def small_model_file(tmp_path: Path) -> Path:
    text = resources.files("bevcli").joinpath("configs/tiny.toml").read_text()
    for old, new in SMALL.items():
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "small.toml"
    path.write_text(text)
    return path
