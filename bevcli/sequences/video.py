"""A video read front to back, without seeking: OpenCV's seeking is off by some images in many codecs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError


@dataclass(frozen=True)
class VideoFacts:
    """What a video file says of itself. count: images, as the container states it. rate_hz: images a second."""

    count: int
    rate_hz: float


class VideoReader:
    """Gives the images of one video by number. Asking in order decodes each once; going back opens it anew."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._capture: cv2.VideoCapture | None = None
        self._at = -1  # the number of the image in `_pixels`
        self._pixels: NDArray[np.uint8] | None = None
        self._end: int | None = None  # how many images there are, once the end was met

    def read(self, index: int) -> NDArray[np.uint8]:
        """(H, W, 3) BGR of image `index`, from 0.

        Raises InputError where the file is missing, no video, or has no such image.
        """
        if self._end is not None and index >= self._end:
            raise InputError(f"{self.path} has no image {index} (the last one is {self._end - 1})")
        if self._capture is None or index < self._at:
            self._capture, self._at, self._pixels = open_capture(self.path), -1, None
        if index == self._at and self._pixels is not None:
            return self._pixels
        while self._at < index:
            if not self._capture.grab():
                self._end, self._capture = self._at + 1, None
                raise InputError(f"{self.path} has no image {index} (the last one is {self._end - 1})")
            self._at += 1
        readable, pixels = self._capture.retrieve()
        if not readable:
            raise InputError(f"{self.path}: image {index} cannot be decoded")
        self._pixels = pixels.astype(np.uint8, copy=False)
        return self._pixels


def open_capture(path: Path) -> cv2.VideoCapture:
    """The opened video. Raises InputError where there is none, or OpenCV cannot read it."""
    if not path.is_file():
        raise InputError(f"{path} is missing")
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise InputError(f"{path} cannot be opened as a video (a codec that OpenCV reads is needed, as H.264 or FFV1)")
    return capture


def video_facts(path: Path) -> VideoFacts:
    """Count and rate of a video. Raises InputError where it cannot be opened or states none."""
    capture = open_capture(path)
    count, rate = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), float(capture.get(cv2.CAP_PROP_FPS))
    capture.release()
    if count <= 0 or not 0 < rate < 10_000:
        raise InputError(f"{path} states {count} images at {rate:g} a second: list its images in frames.csv")
    return VideoFacts(count, rate)
