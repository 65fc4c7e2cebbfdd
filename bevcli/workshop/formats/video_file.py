"""A single video as a sequence: one camera, a frame for each image, and no poses but those of `ego_motion_file`.

Of a video of uneven frame rate, the times of the images are those that its container states. MP4 and MOV have tables of
them, MKV and WebM have them beside each image. No image is decoded, but where an MP4 file is written in fragments.
"""

import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.parsing.files import MIB, open_regular
from bevcli.printing import counted
from bevcli.sequences.files.calibration_file import draft_of
from bevcli.sequences.images import ImageSource, open_capture
from bevcli.sequences.native import FolderOptions
from bevcli.sequences.native.folder import FolderDrive
from bevcli.sequences.options import InputOptions
from bevcli.workshop.formats.calibrations import SEVERAL
from bevcli.workshop.formats.matching import CameraImages

UNEVEN = 0.1  # of the period of a video: images farther from even times are at those of the container
UNEVEN_TEXT = "at uneven times, those of the container"
Times = NDArray[np.int64]
MOST_IMAGES = 10_000_000
LARGEST_TABLE = 64 * MIB
EBML, RIFF = b"\x1a\x45\xdf\xa3", b"RIFF"  # first bytes of MKV and WebM, and of AVI, whose rate is even
# Elements of Matroska: those that contain others, and those that are read.
CONTAINERS = {0x18538067, 0x1549A966, 0x1654AE6B, 0xAE, 0x1F43B675, 0xA0}
SCALE, TRACK, TRACK_TYPE, CLUSTER_TIME, BLOCKS = 0x2AD7B1, 0xD7, 0x83, 0xE7, (0xA3, 0xA1)
SMALLEST_IMAGE = 8  # bytes of a container for each of its images, at least
VIDEO = 1  # the type of a track
Box = tuple[bytes, int, int]  # of MP4: kind, and where its contents begin and end


def open_video(path: Path, common: InputOptions, options: FolderOptions) -> FolderDrive:
    """A video as a `Drive`. Raises InputError."""
    draft = draft_of(options, path)
    if draft is None:
        raise InputError(
            f"{path}: a video does not state its camera: pass `fov_deg=70` (`--fov 70`) and `height=1.5` (`--height "
            "1.5`), or `calibration` (`--calibration FILE`)"
        )
    rig = draft.rig
    if len(rig.cameras) != 1:  # of a calibration.json
        if path.stem not in rig.names:
            raise InputError(f"{path}: {SEVERAL.format(counted(len(rig.cameras), 'cameras'), ', '.join(rig.names))}")
        draft = replace(draft, rig=replace(rig, cameras=(rig[path.stem],)))
    is_without = options.ego_motion_file is None and common.ego_motion != "static"
    if is_without and common.ego_motion == "required":
        raise InputError(
            f"{path}: a video has no poses of the vehicle: pass `ego_motion_file` (`--ego-motion FILE`), "
            "`odometry=True` (`--odometry`) to measure them from the images, `temporal=False` (`--no-temporal`) to run "
            'without history, or `ego_motion="static"` (`--static`) if the vehicle stands'
        )
    drive = FolderDrive(path, replace(common, ego_motion="measured") if is_without else common, options, draft)
    drive.name = path.resolve().stem
    if is_without and common.ego_motion != "measured":
        drive.notes = (*drive.notes, "a video has no poses: boxes are in the ego frame")
    return drive


def video_images(path: Path, start_ns: int = 0, rate_hz: float | None = None) -> CameraImages:
    """The images of a video. start_ns: time of the first. rate_hz: default the one stated in the video.

    Where the images are not evenly spaced, their times are those of the container. Raises InputError.
    """
    count, own_rate_hz = count_and_rate(path)
    times = np.round(np.arange(count) * 1e9 / (rate_hz or own_rate_hz)).astype(np.int64)
    stated = container_times_ns(path) if rate_hz is None else None
    period, is_uneven = 1e9 / (rate_hz or own_rate_hz), False
    if stated is not None and len(stated) > 1:
        is_uneven = bool(np.abs(stated - np.arange(len(stated)) * period).max() > UNEVEN * period)
    if stated is not None and is_uneven:
        times, period = stated, float(np.median(np.diff(stated)))
    times = start_ns + times
    return CameraImages(path.name, times, period, lambda index: ImageSource(path, int(times[index]), index), is_uneven)


def count_and_rate(path: Path) -> tuple[int, float]:
    """Number of images and images per second, as the container states them. Raises InputError where it does not."""
    capture = open_capture(path)
    count, rate = float(capture.get(cv2.CAP_PROP_FRAME_COUNT)), float(capture.get(cv2.CAP_PROP_FPS))
    capture.release()
    if not 0 < count <= path.stat().st_size / SMALLEST_IMAGE or not 0.001 < rate < 10_000:
        raise InputError(f"{path} states {count:.0f} images at {rate:g} per second: list its images in frames.csv")
    return int(count), rate


def container_times_ns(path: Path) -> Times | None:
    """(N,) times of a video's images, in the order in which they are shown, the first at 0. None where it has none."""
    with open_regular(path) as file:
        start, size = file.read(4), file.seek(0, 2)
        if start == RIFF:
            return None
        times = _times_in_matroska(file, size) if start == EBML else _times_in_mp4(file, size)
    times = _times_of_images(path) if times is None else times
    return np.sort(times) - times.min() if len(times) else None


def _times_of_images(path: Path) -> Times:
    """The times of all images, which are decoded for it."""
    capture, times = open_capture(path), list[float]()
    while len(times) < MOST_IMAGES and capture.grab():
        times.append(capture.get(cv2.CAP_PROP_POS_MSEC))
    capture.release()
    return np.round(np.array(times) * 1e6).astype(np.int64)


def _times_in_mp4(file: IO[bytes], size: int) -> Times | None:
    """Unsorted times, ns, of the first track of images; None for a file in fragments, or without its tables."""
    for track in _inside(file, (b"", 0, size), b"moov", b"trak"):
        if not any(_read(file, box)[8:12] == b"vide" for box in _inside(file, track, b"mdia", b"hdlr")):
            continue
        headers = [_read(file, box) for box in _inside(file, track, b"mdia", b"mdhd")]
        tables = {
            name: [_read(file, box) for box in _inside(file, track, b"mdia", b"minf", b"stbl", name)]
            for name in (b"stts", b"ctts")
        }
        durations = _runs(tables[b"stts"][0]) if tables[b"stts"] else None
        if not headers or len(headers[0]) < 24 or durations is None or not len(durations):
            return None
        (scale,) = struct.unpack(">I", headers[0][20:24] if headers[0][0] else headers[0][12:16])
        delays = _runs(tables[b"ctts"][0]) if tables[b"ctts"] else np.zeros(len(durations), dtype=np.int64)
        if not scale or delays is None or len(delays) != len(durations):
            return None
        units = np.cumsum(durations) - durations + delays
        return np.round(units * (1e9 / scale)).astype(np.int64)
    return None


def _inside(file: IO[bytes], box: Box, *kinds: bytes) -> Iterator[Box]:
    """The boxes on a path of kinds in a box."""
    if not kinds:
        yield box
        return
    _, position, end = box
    while position + 8 <= end:
        file.seek(position)
        size, kind = struct.unpack(">I4s", file.read(8))
        head = 8
        if size == 1:
            size, head = int.from_bytes(file.read(8), "big"), 16
        size = size or end - position
        if size < head or position + size > end:
            return
        if kind == kinds[0]:
            yield from _inside(file, (kind, position + head, position + size), *kinds[1:])
        position += size


def _read(file: IO[bytes], box: Box) -> bytes:
    file.seek(box[1])
    return file.read(min(box[2] - box[1], LARGEST_TABLE))


def _runs(table: bytes) -> Times | None:
    """(N,) values of a table with pairs of a count and a value; None where there are too many."""
    pairs = np.frombuffer(table[8 : 8 + (len(table) - 8) // 8 * 8], dtype=">i4").reshape(-1, 2).astype(np.int64)
    if (pairs[:, 0] < 0).any() or pairs[:, 0].sum() > MOST_IMAGES:
        return None
    return np.repeat(pairs[:, 1], pairs[:, 0])


def _times_in_matroska(file: IO[bytes], size: int) -> Times:
    """Times, ns, of the first track of images. Elements of unknown length, as live recordings have, do not matter."""
    scale, track, video, cluster, times = 1_000_000, 0, None, 0, list[int]()
    position = 0
    while position < size and len(times) < MOST_IMAGES:
        file.seek(position)
        head = file.read(12)
        name, after_name = _number(head, 0, keep_mark=True)
        length, after_length = _number(head, after_name)
        if not after_name or not after_length:
            break
        position += after_length
        if name in CONTAINERS:
            continue
        if name in (SCALE, TRACK, TRACK_TYPE, CLUSTER_TIME, *BLOCKS):
            file.seek(position)
            contents = file.read(min(length, 16))
            value = int.from_bytes(contents[:8], "big")
            scale = value if name == SCALE else scale
            track = value if name == TRACK else track
            cluster = value if name == CLUSTER_TIME else cluster
            video = track if name == TRACK_TYPE and value == VIDEO and video is None else video
            if name in BLOCKS:
                number, after = _number(contents, 0)
                if number == video and len(contents) >= after + 2:
                    times.append((cluster + struct.unpack_from(">h", contents, after)[0]) * scale)
        position += length
    return np.array(times, dtype=np.int64)


def _number(data: bytes, start: int, *, keep_mark: bool = False) -> tuple[int, int]:
    """A number of Matroska, whose first bits state its length, and where it ends; 0 as the end where there is none."""
    count = 9 - data[start].bit_length() if len(data) > start else 9
    if count > 8 or len(data) < start + count:
        return 0, 0
    value = int.from_bytes(data[start : start + count], "big")
    return (value if keep_mark else value & (1 << 7 * count) - 1), start + count
