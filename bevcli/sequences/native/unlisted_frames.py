"""Finds the frames of a folder without frames.csv: from image names, or from one video per camera.

timing.toml states their times:
start_ns = 1533151603547590000   # time of the first image; default 0
rate_hz = 12.0                   # images per second; default for a video: the rate in its file
[cameras.CAM_BACK]               # where one camera differs
offset_ns = 25000000             # its first image is this much later than start_ns
rate_hz = 24.0
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.parsing.documents import TOML_BYTES, parse_toml
from bevcli.parsing.files import is_there, read_text
from bevcli.sequences.images import IMAGE_SUFFIXES, VIDEO_SUFFIXES, FrameEntry, ImageSource
from bevcli.sequences.video import VideoFacts, video_facts

FILE_NAME = "timing.toml"
# A number in an image's name is a time in nanoseconds from this value on (hours after 1970), an index below it.
SMALLEST_TIMESTAMP = 10**13
ASSUMED_RATE_HZ = 2.0  # rate of numbered images without timing.toml: the rate of the published models


@dataclass(frozen=True)
class CameraTiming:
    """Timing of one camera. offset_ns: its first image is this much later than the common start. rate_hz: its own."""

    offset_ns: int = 0
    rate_hz: float | None = None


@dataclass(frozen=True)
class Timing:
    """Timing of numbered images or videos, see the top of this file. cameras: those that differ, by name."""

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
    if not is_there(path):
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


def find_frames(folder: Path, cameras: tuple[str, ...]) -> tuple[tuple[FrameEntry, ...], str]:
    """The frames in `images/CAMERA/*` or `videos/CAMERA.*`, and a note that tells the user how they were found.

    Raises InputError if there is neither, or if the cameras' images do not have the same names.
    """
    timing = read_timing(folder, cameras)
    if (folder / "images").is_dir():
        return _from_names(folder, cameras, timing)
    if (folder / "videos").is_dir():
        return _from_videos(folder, cameras, timing)
    raise InputError(
        f"{folder}: frames.csv, images/ and videos/ are missing: add a frames.csv, "
        "images/CAMERA/TIMESTAMP.jpg, or videos/CAMERA.mp4"
    )


def _from_names(folder: Path, cameras: tuple[str, ...], timing: Timing) -> tuple[tuple[FrameEntry, ...], str]:
    images = {name: _numbered(folder / "images" / name) for name in cameras}
    numbers = _common_numbers(folder, images)
    are_times = numbers[0] >= SMALLEST_TIMESTAMP
    rate = timing.rate_hz or ASSUMED_RATE_HZ
    entries = []
    for place, number in enumerate(numbers):
        time = number if are_times else timing.time_of("", number - numbers[0], rate)
        sources = {
            name: ImageSource(found[number], time + timing.time_of(name, 0, rate) - timing.start_ns)
            for name, found in images.items()
        }
        stamp = FrameStamp(place if are_times else number, "", time)
        entries.append(FrameEntry(stamp, sources, {}, f"{folder / 'images'}: image {number}"))
    how = "timestamps from the image names" if are_times else f"numbered images at {rate:g} per second"
    where = "" if are_times or timing.rate_hz else f" (assumed; set rate_hz in {FILE_NAME})"
    return tuple(entries), f"frames.csv is missing: found {len(numbers)} frames, {how}{where}"


def _numbered(folder: Path) -> dict[int, Path]:
    """The images of a folder by the number in their name."""
    if not folder.is_dir():
        raise InputError(f"{folder}: the folder is missing (the calibration has the camera {folder.name})")
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in IMAGE_SUFFIXES:
            continue
        if not (path.stem.isascii() and path.stem.isdigit()):
            raise InputError(f"{path}: the name is not a number (expected a time or an index): list it in frames.csv")
        if int(path.stem) in found:
            raise InputError(f"{path}: {found[int(path.stem)].name} has the same number: remove one")
        found[int(path.stem)] = path
    if not found:
        raise InputError(f"{folder}: the folder has no images (expected files ending in {', '.join(IMAGE_SUFFIXES)})")
    return found


def _common_numbers(folder: Path, images: Mapping[str, Mapping[int, Path]]) -> list[int]:
    """The sorted image numbers, which must be the same for every camera."""
    everywhere = sorted(set().union(*images.values()))
    for name, found in images.items():
        missing = [number for number in everywhere if number not in found]
        if missing:
            raise InputError(
                f"{folder / 'images' / name}: {len(missing)} images are missing that other cameras have, the first "
                f"is {missing[0]}: add them, or list the frames in frames.csv and leave cells empty"
            )
    return everywhere


def _from_videos(folder: Path, cameras: tuple[str, ...], timing: Timing) -> tuple[tuple[FrameEntry, ...], str]:
    """One frame for each image of the camera with the lowest rate, with the other cameras' nearest images."""
    paths = {name: _video_of(folder / "videos", name) for name in cameras}
    facts = {name: video_facts(path) for name, path in paths.items()}
    rates = {name: timing.rate_of(name) or facts[name].rate_hz for name in cameras}
    leading = min(cameras, key=lambda name: rates[name])  # the first of cameras with equal rates
    entries = []
    for place in range(facts[leading].count):
        time = timing.time_of(leading, place, rates[leading])
        sources, dropped = {}, {}
        for name in cameras:
            source = _nearest(paths[name], facts[name], name, timing, rates[name], time)
            if source is None:
                dropped[name] = f"{paths[name].name} has no image within {500 / rates[name]:.0f} ms of {time} ns"
            else:
                sources[name] = source
        entries.append(FrameEntry(FrameStamp(place, "", time), sources, dropped, f"{paths[leading]}#{place}"))
    has_timing = is_there(folder / FILE_NAME)
    stated = f"times from {FILE_NAME}" if has_timing else f"starting at time 0 (set start_ns in {FILE_NAME})"
    note = f"frames.csv is missing: found {len(entries)} frames from {leading}, {rates[leading]:g} per second"
    return tuple(entries), f"{note}, {stated}"


def _video_of(folder: Path, camera: str) -> Path:
    found = [path for path in sorted(folder.glob(f"{camera}.*")) if path.suffix.lower() in VIDEO_SUFFIXES]
    if len(found) != 1:
        names = ", ".join(path.name for path in found) or "none"
        raise InputError(f"{folder}: camera {camera}: expected one video, such as {camera}.mp4, found {names}")
    return found[0]


def _nearest(
    path: Path, facts: VideoFacts, camera: str, timing: Timing, rate_hz: float, time: int
) -> ImageSource | None:
    """The camera's image nearest to a time in ns, None if it is more than half a period away."""
    first = timing.time_of(camera, 0, rate_hz)
    number = int(np.clip(round((time - first) * rate_hz / 1e9), 0, facts.count - 1))
    taken = timing.time_of(camera, number, rate_hz)
    if abs(taken - time) > 0.501e9 / rate_hz:
        return None
    return ImageSource(path, taken, number)
