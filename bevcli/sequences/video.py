"""Reads a video from front to back. It never seeks, because OpenCV's seeking is inexact in many codecs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError


@dataclass(frozen=True)
class VideoFacts:
    """Facts from the container of a video.

    Attributes:
        count: number of images.
        rate_hz: images per second.
    """

    count: int
    rate_hz: float


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
            raise InputError(f"{self.path} has no image {index} (the last is {self._end - 1})")
        if self._capture is None or index < self._at:
            self._capture, self._at, self._pixels = open_capture(self.path), -1, None
        if index == self._at and self._pixels is not None:
            return self._pixels
        while self._at < index:
            if not self._capture.grab():
                self._end, self._capture = self._at + 1, None
                raise InputError(f"{self.path} has no image {index} (the last is {self._end - 1})")
            self._at += 1
        readable, pixels = self._capture.retrieve()
        if not readable:
            raise InputError(f"{self.path}: image {index} cannot be decoded")
        self._pixels = pixels.astype(np.uint8, copy=False)
        return self._pixels


def open_capture(path: Path) -> cv2.VideoCapture:
    """Open a video. Raises InputError if it is missing or OpenCV cannot read it."""
    if not path.is_file():
        raise InputError(f"{path} is missing")
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise InputError(f"{path} cannot be opened as a video (expected a codec such as H.264 or FFV1)")
    return capture


def video_facts(path: Path) -> VideoFacts:
    """Number of images and rate of a video. Raises InputError if it cannot be opened or does not state them."""
    capture = open_capture(path)
    count, rate = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), float(capture.get(cv2.CAP_PROP_FPS))
    capture.release()
    if count <= 0 or not 0 < rate < 10_000:
        raise InputError(f"{path} states {count} images at {rate:g} per second: list its images in frames.csv")
    return VideoFacts(count, rate)
