"""Reads the images of a frame from files or videos and decodes them in parallel."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import CameraImage
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.sequences.video import VideoReader

DECODING_THREADS = 6
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
VIDEO_SUFFIXES = (".mp4", ".mkv", ".avi", ".webm", ".mov", ".m4v")
# The calibration refers to the pixels as they are stored, so an EXIF orientation must not rotate them.
DECODE_FLAGS = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


@dataclass(frozen=True)
class ImageSource:
    """Where one image is, and when it was taken.

    Attributes:
        path: an image file or a video.
        timestamp_ns: time of the image.
        video_index: index of the image in the video, from 0. None for an image file.
    """

    path: Path
    timestamp_ns: int
    video_index: int | None = None

    def __str__(self) -> str:
        return str(self.path) if self.video_index is None else f"{self.path}#{self.video_index}"


class UnreadableImage(Exception):
    """An image is missing or broken. The message is the reason."""


class Source(Protocol):
    """Where one image is: an `ImageSource`, or one of another format, which reads itself.

    Attributes:
        timestamp_ns: time of the image, at least roughly.
    """

    @property
    def timestamp_ns(self) -> int: ...


@runtime_checkable
class ReadableSource(Protocol):
    """A source that reads its own image. It may be used from several threads."""

    def read(self) -> CameraImage:
        """The image. Raises UnreadableImage."""
        ...


class ImageReader:
    """Reads the images of frames, which should be asked for in order.

    strict: a missing or broken image raises InputError.
    """

    def __init__(self, *, strict: bool = False) -> None:
        self._strict = strict
        self._videos: dict[str, VideoReader] = {}  # by camera, so that only one thread at a time uses a reader
        self._threads = ThreadPoolExecutor(DECODING_THREADS, thread_name_prefix="decode")

    def read(
        self, sources: Mapping[str, Source], rig: CameraRig, dropped: Mapping[str, str]
    ) -> tuple[dict[str, CameraImage], dict[str, str]]:
        """The images by camera, and the reasons for missing images by camera.

        dropped: cameras already known to have no image, with the reasons.
        Raises InputError for an image whose size differs from the calibration and, with `strict`, a missing image.
        """
        if self._strict and dropped:
            camera, reason = next(iter(dropped.items()))
            raise InputError(f"camera {camera}: {reason}: add the image, or remove --strict")
        tasks = {name: self._threads.submit(self._read_one, source, rig[name]) for name, source in sources.items()}
        images: dict[str, CameraImage] = {}
        reasons = dict(dropped)
        for name, task in tasks.items():
            try:
                images[name] = task.result()
            except UnreadableImage as unreadable:
                if self._strict:
                    hint = "replace the image, or remove --strict"
                    raise InputError(f"camera {name}: {unreadable}: {hint}") from None
                reasons[name] = str(unreadable)
        return images, reasons

    def _read_one(self, source: Source, camera: Camera) -> CameraImage:
        if isinstance(source, ReadableSource):
            image = source.read()
        elif not isinstance(source, ImageSource):
            raise TypeError(f"{source} is not an image source")
        elif source.video_index is None:
            image = _read_file(source)
        else:
            image = CameraImage(source.timestamp_ns, self._read_video(source, camera.name))
        height, width = image.pixels_bgr.shape[:2]
        if (width, height) != (camera.width, camera.height):
            raise InputError(
                f"{source}: camera {camera.name}: the image is {width}x{height} (expected {camera.width}x"
                f"{camera.height}, as in the calibration): use the calibration of this image size"
            )
        return image

    def _read_video(self, source: ImageSource, camera: str) -> NDArray[np.uint8]:
        reader = self._videos.get(camera)
        if reader is None or reader.path != source.path:
            reader = self._videos[camera] = VideoReader(source.path)
        assert source.video_index is not None
        try:
            return reader.read(source.video_index)
        except InputError as error:
            raise UnreadableImage(str(error)) from None


def _read_file(source: ImageSource) -> CameraImage:
    try:
        encoded = source.path.read_bytes()
    except FileNotFoundError:
        raise UnreadableImage(f"{source.path} is missing") from None
    except OSError as error:
        raise UnreadableImage(f"{source.path} cannot be read ({error.strerror})") from None
    media_type = media_type_of(encoded)
    pixels = decode(encoded)
    if pixels is None:
        raise UnreadableImage(f"{source.path} is not a complete image")
    return CameraImage(source.timestamp_ns, pixels, encoded if media_type else None, media_type)


def decode(encoded: bytes) -> NDArray[np.uint8] | None:
    """(H, W, 3) uint8 BGR of an encoded image; None if it is not an image or incomplete."""
    if not encoded or _is_cut_short(encoded):
        return None
    pixels = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), DECODE_FLAGS)
    return None if pixels is None else pixels.astype(np.uint8, copy=False)


def media_type_of(encoded: bytes) -> str | None:
    """The media type of an encoded image: "image/jpeg", "image/png", or None for another format."""
    if encoded.startswith(b"\xff\xd8\xff"):
        return "image/jpeg"
    return "image/png" if encoded.startswith(b"\x89PNG\r\n") else None


def _is_cut_short(encoded: bytes) -> bool:
    """Whether the end of a JPEG or PNG is missing. OpenCV fills the missing part with grey, without an error."""
    kind = media_type_of(encoded)
    if kind == "image/jpeg":
        return encoded.rfind(b"\xff\xd9") < encoded.rfind(b"\xff\xda")  # the end marker comes before the last scan
    return kind == "image/png" and b"IEND" not in encoded[-64:]
