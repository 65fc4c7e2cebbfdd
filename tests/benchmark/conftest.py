"""Model files for benchmarks that take seconds."""

from collections.abc import Iterator
from functools import cache
from importlib import resources
from pathlib import Path

import pytest

from bevcli.workshop.benchmark import versions

SMALL = {
    "size = [800, 450]": "size = [160, 90]",
    "rows = 50": "rows = 12",
    "columns = 50": "columns = 10",
    "channels = 256": "channels = 32",
    "blocks = [3, 4, 6, 3]": "blocks = [1, 1, 1, 1]\nwidth = 8",
    "queries = 900": "queries = 30",
}
SMALL_UNIAD = {
    "size = [1600, 900]": "size = [160, 90]",
    "rows = 200": "rows = 12",
    "columns = 200": "columns = 10",
    "channels = 256": "channels = 32",
    "blocks = [3, 4, 23, 3]": "blocks = [1, 1, 1, 1]\nwidth = 8",
    "queries = 901": "queries = 30",
}


@pytest.fixture(scope="session", autouse=True)
def images_made_once() -> Iterator[None]:
    """The images of made-up drives, which are always the same."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(versions, "_jpeg", cache(versions._jpeg))
        yield


@pytest.fixture
def small_model_file(tmp_path: Path) -> Path:
    return model_file(tmp_path / "small.toml", "tiny", SMALL)


@pytest.fixture
def small_uniad_file(tmp_path: Path) -> Path:
    return model_file(tmp_path / "uniad.toml", "uniad-track-map", SMALL_UNIAD)


def model_file(path: Path, model: str, changes: dict[str, str]) -> Path:
    """Writes a known model's TOML file with changed lines."""
    text = resources.files("bevcli").joinpath(f"configs/{model}.toml").read_text()
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return path
