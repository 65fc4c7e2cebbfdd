"""The frames of a native sequence folder without frames.csv, which are found by image names or videos.

timing.toml states their times:
start_ns = 1533151603547590000   # time of the first image; default 0
rate_hz = 12.0                   # images per second; default for a video: the rate in its file
times = "us"                     # unit of the times in image names; default: found from the numbers
[cameras.CAM_BACK]               # where one camera differs
offset_ns = 25000000             # its first image is this much later than start_ns
rate_hz = 24.0
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.ego_motion import EgoMotion
from bevcli.parsing.documents import TOML_BYTES, parse_toml, typed
from bevcli.parsing.files import IMAGE_SUFFIXES, VIDEO_SUFFIXES, is_there, read_text
from bevcli.printing import counted
from bevcli.sequences.images import FrameEntry, ImageSource
from bevcli.sequences.native import LARGEST_NS, RATES_HZ, FolderOptions, TimeKind
from bevcli.workshop.formats.camera_names import folder_of_images, match_names, renamed
from bevcli.workshop.formats.matching import (
    CameraImages,
    Found,
    frames_at,
    match,
    measured_periods,
)
from bevcli.workshop.formats.name_times import NUMBER, Reading, listed_times, read_names
from bevcli.workshop.formats.video_file import UNEVEN_TEXT, video_images

FILE_NAME = "timing.toml"
Nanoseconds = Annotated[int, Meta(ge=-LARGEST_NS, le=LARGEST_NS)]
ASSUMED_RATE_HZ = 2.0  # rate of numbered images without timing.toml: the rate of the published models


class _Rate(Struct, forbid_unknown_fields=True):
    rate_hz: float | None = None  # images per second, None if not stated

    def __post_init__(self) -> None:
        if self.rate_hz is not None and not RATES_HZ[0] <= self.rate_hz <= RATES_HZ[1]:
            raise ValueError("rate_hz: expected images per second, above 0")


class CameraTiming(_Rate):
    """What timing.toml states of one camera."""

    offset_ns: Nanoseconds = 0  # delay of its first image


class Timing(_Rate):
    """What timing.toml and the options state of images without a table."""

    start_ns: Nanoseconds | None = None  # time of the first image, None if not stated
    times: TimeKind | None = None  # what the numbers in image names are, None if not stated
    cameras: dict[str, CameraTiming] = {}


def read_timing(folder: Path, cameras: tuple[str, ...], own: FolderOptions = FolderOptions()) -> Timing:
    """The timing in timing.toml; the defaults if the file is missing. own: options, which replace what it states.

    Raises InputError for broken TOML, an unknown key or camera, or an invalid value.
    """
    path = folder / FILE_NAME
    stated = typed(parse_toml(read_text(path, TOML_BYTES), path) if is_there(path) else {}, Timing, path)
    for name in stated.cameras.keys() - set(cameras):
        raise InputError(f'{path}: unknown camera "{name}" (known: {", ".join(cameras)})')
    rate_hz = own.image_rate_hz or stated.rate_hz
    of_cameras = {name: stated.cameras.get(name, CameraTiming()) for name in cameras}
    made = {name: CameraTiming(of.rate_hz or rate_hz, of.offset_ns) for name, of in of_cameras.items()}
    start_ns = stated.start_ns if own.start_ns is None else own.start_ns
    return Timing(rate_hz, start_ns, own.times or stated.times, made)


def find_frames(
    folder: Path,
    cameras: tuple[str, ...],
    own: FolderOptions = FolderOptions(),
    motion: EgoMotion | None = None,
    *,
    has_poses: bool = False,
) -> Found:
    """The frames in `images/CAMERA/*`, `CAMERA/*` or `videos/CAMERA.*`, and a note that tells how they were understood.

    folder: or the video of the only camera.
    motion: the poses, which decide where the names of images have two readings. None where they are not known yet.
    has_poses: there are poses, for which the rate of numbered images must be known.
    Raises InputError if there are no images, or their times are not known.
    """
    if folder.is_file():
        return _from_video(folder, cameras[0], own)
    timing = read_timing(folder, cameras, own)
    if (folder / "images").is_dir():
        entries, line = _from_names(folder / "images", timing, motion, has_poses)
    elif (folder / "videos").is_dir():
        entries, line = _from_videos(folder, timing)
    elif match_names(cameras, _folders(folder)):
        entries, line = _from_names(folder, timing, motion, has_poses)
    else:
        raise InputError(
            f"{folder}: frames.csv, images/ and videos/ are missing: add a frames.csv, "
            "images/CAMERA/TIMESTAMP.jpg, or videos/CAMERA.mp4"
        )
    return entries, f"frames.csv is missing: found {counted(len(entries), 'frames')}: {line}"


def _folders(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.is_dir())


def _from_names(folder: Path, timing: Timing, motion: EgoMotion | None, has_poses: bool) -> Found:
    """Frames of image files, and what their names were understood as."""
    found = _folders(folder)
    matched = match_names(timing.cameras, found)
    for camera in timing.cameras:
        if camera not in matched:
            others = ", ".join(name for name in found if name not in matched.values()) or "no other folder"
            raise InputError(
                f"{folder / camera}: the folder is missing (the calibration has the camera {camera}; found {others}): "
                "name the folder like the camera"
            )
    paths = {camera: _image_files(folder_of_images(folder / name)) for camera, name in matched.items()}
    names = {camera: [path.stem for path in of_camera] for camera, of_camera in paths.items()}
    reading = read_names(folder, names, motion, timing.times)
    if reading.kind == "index":
        entries, line = _from_indices(folder, paths, reading, timing, motion, has_poses)
    else:
        entries, line = _from_times(paths, reading, timing)
    return entries, line + renamed(matched)


def _image_files(folder: Path) -> list[Path]:
    files = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in IMAGE_SUFFIXES]
    images: dict[str, Path] = {}
    for path in (path for path in files if not path.name.startswith(".")):
        if not NUMBER.search(path.stem):
            raise InputError(f"{path}: the name has no number (expected a time or an index): list it in frames.csv")
        if path.stem in images:
            raise InputError(f"{path}: {images[path.stem].name} has the same number: remove one")
        images[path.stem] = path
    if not images:
        raise InputError(f"{folder}: the folder has no images (expected files ending in {', '.join(IMAGE_SUFFIXES)})")
    return list(images.values())


def _from_times(paths: Mapping[str, list[Path]], reading: Reading, timing: Timing) -> Found:
    """Frames of images whose names are times: of all cameras those that are nearest to each other."""
    start, first = timing.start_ns, min(int(times.min()) for times in reading.values.values())
    moved = 0 if start is None else start - first
    cameras = {}
    periods = measured_periods(reading.values)
    for camera, of_camera in paths.items():
        times = reading.values[camera] + moved + timing.cameras[camera].offset_ns
        order = np.argsort(times)
        sources = [ImageSource(of_camera[index], int(times[index])) for index in order.tolist()]
        cameras[camera] = CameraImages(f"the folder {of_camera[0].parent.name}", times[order], periods[camera],
                                       sources.__getitem__)  # fmt: skip
    of_start = f", moved so that the first is {start} ns" if moved and reading.is_known_origin else ""
    return _matched(f"times are {reading.words}{of_start}", cameras)


def _matched(times: str, cameras: Mapping[str, CameraImages]) -> Found:
    """The frames of cameras, with the rates and how they were matched. times: how these are stated."""
    leading, entries = match(cameras)
    rates = sorted({f"{1e9 / each.period_ns:.1f}" for each in cameras.values()}, key=float)
    uneven = [each.name for each in cameras.values() if each.is_uneven]
    parts = [times, f"{counted(len(cameras), 'cameras')} at {' to '.join(rates[:: max(len(rates) - 1, 1)])} Hz"]
    if len(cameras) > 1:
        apart = max(max(entry.times_ns) - entry.stamp.timestamp_ns for entry in entries)
        apart = max(apart, *(entry.stamp.timestamp_ns - min(entry.times_ns) for entry in entries))
        parts.append(f"matched to {leading} within {np.ceil(apart / 1e6):.0f} ms")
    if uneven:
        parts.append(f"{', '.join(uneven)} {UNEVEN_TEXT}")
    return entries, ", ".join([*parts, _missing(entries)])


def _missing(entries: Sequence[FrameEntry]) -> str:
    missing = sum(len(entry.dropped) for entry in entries)
    return f"{missing or 'none'} of {counted(missing + sum(len(each.sources) for each in entries), 'images')} missing"


def _from_indices(
    folder: Path,
    paths: Mapping[str, list[Path]],
    reading: Reading,
    timing: Timing,
    motion: EgoMotion | None,
    has_poses: bool,
) -> Found:
    """Frames of numbered images: each has the images of one number."""
    numbered = {camera: dict(zip(reading.values[camera].tolist(), of, strict=True)) for camera, of in paths.items()}
    numbers = sorted(set().union(*numbered.values()))
    _check_numbers(folder, numbered)
    stated = _listed_times(folder, numbered, timing)
    if stated is None:
        times, how = _times_of_indices(folder, numbers, timing, motion, has_poses)
        time_of = dict(zip(numbers, times, strict=True))
        stated = dict.fromkeys(numbered, time_of), how
    times_of, how = stated
    entries = list[FrameEntry]()
    for number in numbers:
        there = {camera: of[number] for camera, of in numbered.items() if number in of}
        sources = {camera: ImageSource(path, times_of[camera][number] + timing.cameras[camera].offset_ns)
                   for camera, path in there.items()}  # fmt: skip
        time = times_of[next(iter(there))][number]
        dropped = {camera: f"no image {number} in {of_camera[0].parent}" for camera, of_camera in paths.items()
                   if camera not in there}  # fmt: skip
        entries.append(FrameEntry(FrameStamp(number, "", time), sources, dropped, f"{folder}: image {number}"))
    return tuple(entries), f"numbered images {how}, {_missing(entries)}"


def _listed_times(
    folder: Path, numbered: Mapping[str, Mapping[int, Path]], timing: Timing
) -> tuple[dict[str, dict[int, int]], str] | None:
    """The times of the images by camera and number that files beside them list, and their words; None without."""
    found = {camera: listed_times(folder, next(iter(of.values())).parent, of) for camera, of in numbered.items()}
    listed = {camera: each for camera, each in found.items() if each is not None}
    if timing.rate_hz is not None or len(listed) < len(numbered):
        return None
    first = min(min(times.values()) for times, _ in listed.values())
    moved = 0 if timing.start_ns is None else timing.start_ns - first
    times = {camera: {number: time + moved for number, time in of.items()} for camera, (of, _) in listed.items()}
    return times, f"with the times of {next(iter(listed.values()))[1]}"


def _check_numbers(folder: Path, numbered: Mapping[str, Mapping[int, Path]]) -> None:
    """Raise InputError for a camera that shares less than half of its numbers with the one that has most images."""
    fullest = max(numbered, key=lambda camera: len(numbered[camera]))
    for camera, of_camera in numbered.items():
        if 2 * len(of_camera.keys() & numbered[fullest].keys()) < len(of_camera):
            spans = [f"{name} has {min(numbered[name])} to {max(numbered[name])}" for name in (camera, fullest)]
            raise InputError(
                f"{folder}: the images are numbered differently: {', and '.join(spans)} (expected the same number for "
                "images of the same time): rename them, or list the frames in frames.csv"
            )


def _times_of_indices(
    folder: Path, numbers: list[int], timing: Timing, motion: EgoMotion | None, has_poses: bool
) -> tuple[list[int], str]:
    """The time of each number, ns, and where it comes from. As many poses as numbers are the poses of the images."""
    first, count = numbers[0], numbers[-1] - numbers[0] + 1
    rate = timing.rate_hz
    if rate is None and motion is not None and timing.start_ns is None and len(motion.timestamps_ns) == count > 1:
        times = motion.timestamps_ns.tolist()
        rate = 1e9 / float(np.median(np.diff(motion.timestamps_ns)))
        return [times[number - first] for number in numbers], f"with the times of the {count} poses ({rate:.1f} Hz)"
    if rate is None and has_poses:
        cover, also = "there are poses", ""
        if motion is not None:
            seconds = (motion.last_ns - motion.first_ns) / 1e9
            cover = f"the poses cover {seconds:.1f} s from {motion.first_ns} ns on"
            also = ", and the time of the first one by `start_ns` (`--start-ns`)"
        raise InputError(
            f"{folder}: the images are numbered {first} to {numbers[-1]}, and {cover}: state the images per second by "
            f"`image_rate_hz` (`--image-rate`){also}"
        )
    assumed = "" if rate else " (assumed: state `image_rate_hz` (`--image-rate`))"
    start, rate = timing.start_ns or 0, rate or ASSUMED_RATE_HZ
    return [start + round((number - first) * 1e9 / rate) for number in numbers], f"at {rate:g} Hz{assumed}"


def _from_video(path: Path, camera: str, own: FolderOptions) -> Found:
    """A frame for each image of a video, and what was understood."""
    video = video_images(path, own.start_ns or 0, own.image_rate_hz)
    entries = frames_at(video.times_ns, {camera: video}, camera)
    start = "time 0 (state `start_ns` (`--start-ns`))" if own.start_ns is None else f"{own.start_ns} ns"
    rate = f"{UNEVEN_TEXT}," if video.is_uneven else f"at {1e9 / video.period_ns:g} Hz"
    return entries, f"{len(entries)} images {rate} from {start} on"


def _from_videos(folder: Path, timing: Timing) -> Found:
    """Frames of videos, one for each image of the slowest, and what was understood."""
    files: dict[str, list[Path]] = {}
    for path in sorted((folder / "videos").iterdir()):
        if path.suffix.lower() in VIDEO_SUFFIXES:
            files.setdefault(path.stem, []).append(path)
    names = match_names(timing.cameras, files)
    videos = {}
    for camera in timing.cameras:
        of_camera = files.get(names.get(camera, ""), [])
        if len(of_camera) != 1:
            found = ", ".join(path.name for path in of_camera) or "none"
            expected = f"one video, such as {camera}.mp4"
            raise InputError(f"{folder / 'videos'}: camera {camera}: expected {expected}, found {found}")
        start_ns = (timing.start_ns or 0) + timing.cameras[camera].offset_ns
        videos[camera] = video_images(of_camera[0], start_ns, timing.cameras[camera].rate_hz)
    is_stated = timing.start_ns is not None or is_there(folder / FILE_NAME)
    stated = "times as stated" if is_stated else "times from 0 on (state `start_ns` (`--start-ns`))"
    entries, line = _matched(stated, videos)
    return entries, line + renamed(names)
