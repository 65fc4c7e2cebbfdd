"""Videos, whose images are read by index. Whatever a container states, an image has the pixels that are stored."""

import contextlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.parsing.files import open_regular, plain_name

# Where the beginning of a file shows its container: offset and bytes. The last row is that of streams in bags.
CONTAINERS = (
    (4, b"ftyp"), (4, b"moov"), (4, b"mdat"), (4, b"wide"), (4, b"free"), (4, b"skip"), (0, b"RIFF"),
    (0, b"\x1a\x45\xdf\xa3"), (0, b"\x00\x00\x00\x01"), (0, b"\x00\x00\x01"),
)  # fmt: skip
MOST_PIXELS = 1 << 26  # of an image in a video or a bag
SMALLEST_IMAGE = 8  # bytes of a container for each of its images, at least


class VideoReader:
    """Reads the images of one video by index. In order, each image is decoded once; going back reopens the video."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._capture: cv2.VideoCapture | None = None
        self._at = -1  # index of the image in `_pixels`
        self._pixels: NDArray[np.uint8] | None = None
        self._end: int | None = None  # number of images, known once the end was reached

    def read(self, index: int) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 BGR of image `index`, from 0.

        Raises InputError if the file is missing, is not a video, or does not have the image.
        """
        if self._end is not None and index >= self._end:
            raise self._without(index)
        if self._capture is None or index < self._at:
            self._capture, self._at, self._pixels = open_capture(self.path), -1, None
        if index == self._at and self._pixels is not None:
            return self._pixels
        while self._at < index:
            grabbed = False
            with contextlib.suppress(cv2.error):  # a damaged stream
                grabbed = self._capture.grab()
            if not grabbed:
                self._end, self._capture = self._at + 1, None
                raise self._without(index)
            self._at += 1
        with contextlib.suppress(cv2.error):
            readable, pixels = self._capture.retrieve()
            if readable:
                self._pixels = pixels.astype(np.uint8, copy=False)
                return self._pixels
        raise InputError(f"{self.path}: image {index} cannot be decoded")

    def _without(self, index: int) -> InputError:
        last = f"the last is {self._end - 1}" if self._end else "none can be decoded, the file is damaged"
        return InputError(f"{self.path} has no image {index} ({last})")


def open_capture(path: Path) -> cv2.VideoCapture:
    """Open a video. Raises InputError if it is missing or OpenCV cannot read it."""
    with open_regular(path, missing="is missing") as file:
        start = file.read(12)
    # FFmpeg recognises playlists too, which could lead it to other files and to servers.
    if not any(start[offset:].startswith(magic) for offset, magic in CONTAINERS):
        raise InputError(f"{path} is not a video (expected MP4, MOV, MKV, WebM or AVI)")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # nothing: what fails here is told in one line
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        with plain_name(path) as name:
            capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG)
    except cv2.error:
        capture = cv2.VideoCapture()
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not capture.isOpened():
        raise InputError(
            f"{path} cannot be opened as a video: it is cut short, has sound only, or a codec that is not read "
            "(expected one such as H.264 or FFV1)"
        )
    # The calibration is that of the pixels as they are stored, and versions of OpenCV differ in whether they turn them.
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    width, height = (capture.get(side) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    if not 0 < width * height <= MOST_PIXELS:
        capture.release()
        raise InputError(f"{path} has images of {width:.0f}x{height:.0f} (expected at most {MOST_PIXELS} pixels)")
    return capture


def size_of_video(path: Path) -> tuple[int, int]:
    """(width, height) of the images of a video, pixels. Raises InputError as `open_capture`."""
    capture = open_capture(path)
    width, height = (int(capture.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    capture.release()
    return width, height


def rotation_notes(paths: Iterable[Path]) -> Iterator[str]:
    """A note on each video with a tag by which players turn its images. Videos that cannot be read have none."""
    for path in paths:
        with contextlib.suppress(InputError):
            degrees = open_capture(path).get(cv2.CAP_PROP_ORIENTATION_META)
            if degrees % 360:
                yield f"{path}: has a rotation tag ({degrees:.0f} degrees): its images are read as they are stored"


def count_and_rate(path: Path) -> tuple[int, float]:
    """Number of images and images per second, as the container states them. Raises InputError where it does not."""
    capture = open_capture(path)
    count, rate = float(capture.get(cv2.CAP_PROP_FRAME_COUNT)), float(capture.get(cv2.CAP_PROP_FPS))
    capture.release()
    if not 0 < count <= path.stat().st_size / SMALLEST_IMAGE or not 0.001 < rate < 10_000:
        raise InputError(f"{path} states {count:.0f} images at {rate:g} per second: list its images in frames.csv")
    return int(count), rate
