"""timing.toml: times of the images in a folder without frames.csv.

start_ns = 1533151603547590000   # time of the first image; default 0
rate_hz = 12.0                   # images per second; default for a video: the rate in its file
[cameras.CAM_BACK]               # where one camera differs
offset_ns = 25000000             # its first image is this much later than start_ns
rate_hz = 24.0
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bevcli.errors import InputError
from bevcli.parsing.documents import TOML_BYTES, parse_toml
from bevcli.parsing.files import read_text

FILE_NAME = "timing.toml"


@dataclass(frozen=True)
class CameraTiming:
    """Timing of one camera.

    Attributes:
        offset_ns: time from the common start to the camera's first image, nanoseconds.
        rate_hz: images per second. None: the common rate.
    """

    offset_ns: int = 0
    rate_hz: float | None = None


@dataclass(frozen=True)
class Timing:
    """Timing of numbered images or videos.

    Attributes:
        start_ns: common start, nanoseconds.
        rate_hz: common number of images per second. None: not stated.
        cameras: timing of cameras that differ, by name.
    """

    start_ns: int = 0
    rate_hz: float | None = None
    cameras: Mapping[str, CameraTiming] = field(default_factory=dict)

    def rate_of(self, camera: str) -> float | None:
        """Images per second of one camera, None if not stated."""
        own = self.cameras.get(camera, CameraTiming()).rate_hz
        return self.rate_hz if own is None else own

    def time_of(self, camera: str, number: int, rate_hz: float) -> int:
        """Time in nanoseconds of a camera's image `number`, from 0."""
        offset = self.cameras.get(camera, CameraTiming()).offset_ns
        return self.start_ns + offset + round(number * 1e9 / rate_hz)


def read_timing(folder: Path, cameras: tuple[str, ...]) -> Timing:
    """The folder's timing.toml, or the defaults if the file is missing.

    Raises InputError for broken TOML, an unknown key or camera, or an invalid value.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return Timing()
    stated = parse_toml(read_text(path, TOML_BYTES), path)
    _check_keys(path, "", stated, ("start_ns", "rate_hz", "cameras"))
    own = stated.get("cameras", {})
    if not isinstance(own, dict):
        raise InputError(f'{path}: "cameras": expected a table for each camera, such as [cameras.{cameras[0]}]')
    _check_keys(path, "cameras.", own, cameras)
    by_camera = {name: _camera(path, name, table) for name, table in own.items()}
    return Timing(_integer(path, "", stated, "start_ns"), _rate(path, "", stated), by_camera)


def _camera(path: Path, name: str, table: Any) -> CameraTiming:
    where = f"cameras.{name}."
    if not isinstance(table, dict):
        raise InputError(f"{path}: cameras.{name}: expected a table, such as [cameras.{name}]")
    _check_keys(path, where, table, ("offset_ns", "rate_hz"))
    return CameraTiming(_integer(path, where, table, "offset_ns"), _rate(path, where, table))


def _check_keys(path: Path, where: str, table: Mapping[str, Any], known: tuple[str, ...]) -> None:
    for key in table:
        if key not in known:
            raise InputError(f'{path}: unknown key "{where}{key}" (known: {", ".join(known)})')


def _integer(path: Path, where: str, table: Mapping[str, Any], key: str) -> int:
    value = table.get(key, 0)
    if not isinstance(value, int) or isinstance(value, bool):
        raise InputError(f"{path}: {where}{key}: expected an integer (nanoseconds), found {value!r}")
    return value


def _rate(path: Path, where: str, table: Mapping[str, Any]) -> float | None:
    value = table.get("rate_hz")
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < 10_000:
        raise InputError(f"{path}: {where}rate_hz: expected images per second, above 0, found {value!r}")
    return float(value)
