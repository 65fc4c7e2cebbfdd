"""The frames of a native sequence folder without frames.csv, which are found by image names or videos.

timing.toml states their times:
start_ns = 1533151603547590000   # time of the first image; default 0
rate_hz = 12.0                   # images per second; default for a video: the rate in its file
[cameras.CAM_BACK]               # where one camera differs
offset_ns = 25000000             # its first image is this much later than start_ns
rate_hz = 24.0
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.parsing.documents import TOML_BYTES, parse_toml
from bevcli.parsing.files import VIDEO_SUFFIXES, is_there, read_text
from bevcli.printing import counted
from bevcli.sequences.images import IMAGE_SUFFIXES, FrameEntry, ImageSource
from bevcli.sequences.videos import count_and_rate

FILE_NAME = "timing.toml"
# A number in an image's name is a time in nanoseconds from this value on (hours after 1970), an index below it.
SMALLEST_TIMESTAMP = 10**13
ASSUMED_RATE_HZ = 2.0  # rate of numbered images without timing.toml: the rate of the published models
Found = tuple[tuple[FrameEntry, ...], tuple[str, ...]]  # frames, and a note


@dataclass(frozen=True)
class Timing:
    """Timing of numbered images or of a video. start_ns: of the first image. rate_hz: None if not stated."""

    start_ns: int
    rate_hz: float | None


@dataclass(frozen=True)
class CameraVideo:
    """The video of a camera: number of images, time of the first, images per second."""

    path: Path
    count: int
    start_ns: int
    rate_hz: float

    def image(self, number: int) -> ImageSource:
        """An image by its number, from 0."""
        return ImageSource(self.path, self.start_ns + round(number * 1e9 / self.rate_hz), number)

    def nearest(self, time: int) -> ImageSource | None:
        """The image nearest to a time in ns, None if it is more than half a period away."""
        number = round((time - self.start_ns) * self.rate_hz / 1e9)
        image = self.image(min(max(number, 0), self.count - 1))
        return image if abs(image.timestamp_ns - time) <= 0.501e9 / self.rate_hz else None


def read_timing(folder: Path, cameras: tuple[str, ...]) -> tuple[Timing, dict[str, Timing]]:
    """The common timing in timing.toml, and that of each camera; the defaults if the file is missing.

    Raises InputError for broken TOML, an unknown key or camera, or an invalid value.
    """
    path = folder / FILE_NAME
    stated = parse_toml(read_text(path, TOML_BYTES), path) if is_there(path) else {}
    _check_keys(path, "", stated, ("start_ns", "rate_hz", "cameras"))
    own = stated.get("cameras", {})
    if not isinstance(own, dict):
        raise InputError(f'{path}: "cameras": expected a table for each camera, such as [cameras.{cameras[0]}]')
    _check_keys(path, "cameras.", own, cameras)
    common = Timing(_integer(path, "", stated, "start_ns"), _rate(path, "", stated))
    return common, {name: _camera(path, f"cameras.{name}", own.get(name, {}), common) for name in cameras}


def _camera(path: Path, where: str, table: Any, common: Timing) -> Timing:
    if not isinstance(table, dict):
        raise InputError(f"{path}: {where}: expected a table, such as [{where}]")
    _check_keys(path, f"{where}.", table, ("offset_ns", "rate_hz"))
    offset_ns = _integer(path, f"{where}.", table, "offset_ns")
    return Timing(common.start_ns + offset_ns, _rate(path, f"{where}.", table) or common.rate_hz)


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


def find_frames(folder: Path, cameras: tuple[str, ...]) -> Found:
    """The frames in `images/CAMERA/*` or `videos/CAMERA.*`, and a note that tells the user how they were found.

    Raises InputError if there is neither, or if the cameras' images do not have the same names.
    """
    common, timings = read_timing(folder, cameras)
    if (folder / "images").is_dir():
        return _from_names(folder, common, timings)
    if (folder / "videos").is_dir():
        return _from_videos(folder, timings)
    raise InputError(
        f"{folder}: frames.csv, images/ and videos/ are missing: add a frames.csv, "
        "images/CAMERA/TIMESTAMP.jpg, or videos/CAMERA.mp4"
    )


def _from_names(folder: Path, common: Timing, timings: Mapping[str, Timing]) -> Found:
    images = {name: _numbered(folder / "images" / name) for name in timings}
    numbers = _common_numbers(folder, images)
    are_times = numbers[0] >= SMALLEST_TIMESTAMP
    rate = common.rate_hz or ASSUMED_RATE_HZ
    entries = []
    for place, number in enumerate(numbers):
        time = number if are_times else common.start_ns + round((number - numbers[0]) * 1e9 / rate)
        sources = {
            name: ImageSource(found[number], time + timings[name].start_ns - common.start_ns)
            for name, found in images.items()
        }
        stamp = FrameStamp(place if are_times else number, "", time)
        entries.append(FrameEntry(stamp, sources, {}, f"{folder / 'images'}: image {number}"))
    how = "timestamps from the image names" if are_times else f"numbered images at {rate:g} per second"
    where = "" if are_times or common.rate_hz else f" (assumed; set rate_hz in {FILE_NAME})"
    return tuple(entries), (f"frames.csv is missing: found {counted(len(numbers), 'frames')}, {how}{where}",)


def _numbered(folder: Path) -> dict[int, Path]:
    if not folder.is_dir():
        raise InputError(f"{folder}: the folder is missing (the calibration has the camera {folder.name})")
    images: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in IMAGE_SUFFIXES:
            continue
        if not (path.stem.isascii() and path.stem.isdigit()):
            raise InputError(f"{path}: the name is not a number (expected a time or an index): list it in frames.csv")
        if int(path.stem) in images:
            raise InputError(f"{path}: {images[int(path.stem)].name} has the same number: remove one")
        images[int(path.stem)] = path
    if not images:
        raise InputError(f"{folder}: the folder has no images (expected files ending in {', '.join(IMAGE_SUFFIXES)})")
    return images


def _common_numbers(folder: Path, images: Mapping[str, Mapping[int, Path]]) -> list[int]:
    """The sorted image numbers, which must be the same for every camera."""
    everywhere = sorted(set().union(*images.values()))
    for name, numbered in images.items():
        missing = [number for number in everywhere if number not in numbered]
        if missing:
            raise InputError(
                f"{folder / 'images' / name}: {len(missing)} images are missing that other cameras have, the first "
                f"is {missing[0]}: add them, or list the frames in frames.csv and leave cells empty"
            )
    return everywhere


def _from_videos(folder: Path, timings: Mapping[str, Timing]) -> Found:
    """One frame for each image of the camera with the lowest rate, with the other cameras' nearest images."""
    videos = {name: _video_of(folder / "videos", name, timing) for name, timing in timings.items()}
    name, leading = min(videos.items(), key=lambda item: item[1].rate_hz)  # the first of cameras with equal rates
    entries = []
    for place in range(leading.count):
        time = leading.image(place).timestamp_ns
        nearest = {camera: video.nearest(time) for camera, video in videos.items()}
        sources = {camera: source for camera, source in nearest.items() if source is not None}
        dropped = {
            camera: f"{video.path.name} has no image within {500 / video.rate_hz:.0f} ms of {time} ns"
            for camera, video in videos.items()
            if nearest[camera] is None
        }
        entries.append(FrameEntry(FrameStamp(place, "", time), sources, dropped, f"{leading.path}#{place}"))
    has_timing = is_there(folder / FILE_NAME)
    stated = f"times from {FILE_NAME}" if has_timing else f"starting at time 0 (set start_ns in {FILE_NAME})"
    note = f"frames.csv is missing: found {counted(len(entries), 'frames')} from {name}, {leading.rate_hz:g} per second"
    return tuple(entries), (f"{note}, {stated}",)


def _video_of(folder: Path, camera: str, timing: Timing) -> CameraVideo:
    videos = [path for path in sorted(folder.glob(f"{camera}.*")) if path.suffix.lower() in VIDEO_SUFFIXES]
    if len(videos) != 1:
        names = ", ".join(path.name for path in videos) or "none"
        raise InputError(f"{folder}: camera {camera}: expected one video, such as {camera}.mp4, found {names}")
    count, rate_hz = count_and_rate(videos[0])
    return CameraVideo(videos[0], count, timing.start_ns, timing.rate_hz or rate_hz)
