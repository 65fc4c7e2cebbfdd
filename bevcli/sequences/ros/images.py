"""Image messages -> pixels: compressed files, and raw pixels in ROS's encodings."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import CameraImage
from bevcli.sequences.images import UnreadableImage, decode, media_type_of
from bevcli.sequences.ros.bag import Bag
from bevcli.sequences.ros.messages import payload, timestamp_ns

# Encoding -> channels, bytes a channel, conversion to BGR. ROS names the top left 2x2 pixels of a Bayer pattern.
RAW_ENCODINGS: dict[str, tuple[int, int, int | None]] = {
    "bgr8": (3, 1, None),
    "8UC3": (3, 1, None),
    "rgb8": (3, 1, cv2.COLOR_RGB2BGR),
    "bgra8": (4, 1, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, 1, cv2.COLOR_RGBA2BGR),
    "mono8": (1, 1, cv2.COLOR_GRAY2BGR),
    "8UC1": (1, 1, cv2.COLOR_GRAY2BGR),
    "mono16": (1, 2, cv2.COLOR_GRAY2BGR),
    "bgr16": (3, 2, None),
    "rgb16": (3, 2, cv2.COLOR_RGB2BGR),
    "uyvy": (2, 1, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422": (2, 1, cv2.COLOR_YUV2BGR_UYVY),
    "yuyv": (2, 1, cv2.COLOR_YUV2BGR_YUYV),
    "yuv422_yuy2": (2, 1, cv2.COLOR_YUV2BGR_YUYV),
}
for pattern in ("rggb", "bggr", "gbrg", "grbg"):
    for bits in (8, 16):
        conversion = getattr(cv2, f"COLOR_Bayer{pattern.upper()}2BGR")
        RAW_ENCODINGS[f"bayer_{pattern}{bits}"] = (1, bits // 8, conversion)


class BagImage:
    """One image message of a bag, read on demand.

    Attributes:
        timestamp_ns: its time according to the index of the bag.
    """

    def __init__(self, bag: Bag, topic: str, index: int, time_ns: int) -> None:
        self._bag, self._topic, self._index = bag, topic, index
        self.timestamp_ns = time_ns

    def __str__(self) -> str:
        return f"{self._bag.path}: {self._topic}: message {self._index}"

    def read(self) -> CameraImage:
        """The image, with the time that its message states.

        Raises UnreadableImage if it is broken, and InputError for an unknown encoding.
        """
        try:
            message = self._bag.message(self._topic, self._index)
        except InputError as error:
            raise UnreadableImage(str(error)) from None
        time = timestamp_ns(message) or self.timestamp_ns
        data = payload(message)
        if hasattr(message, "encoding"):
            return CameraImage(time, raw_pixels(message, data, str(self)))
        pixels = decode(data)
        if pixels is None:
            raise UnreadableImage(f"{self} is not a complete image")
        media_type = media_type_of(data)
        return CameraImage(time, pixels, data if media_type else None, media_type)


def raw_pixels(message: Any, data: bytes, where: str) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 BGR of a sensor_msgs/Image or foxglove.RawImage.

    Raises InputError for an encoding that is not supported, and UnreadableImage if bytes are missing.
    """
    known = RAW_ENCODINGS.get(str(message.encoding))
    if known is None:
        raise InputError(
            f"{where}: encoding {message.encoding} is not supported (expected {', '.join(list(RAW_ENCODINGS)[:8])} or "
            "a Bayer pattern)"
        )
    channels, depth, conversion = known
    height, width = int(message.height), int(message.width)
    row_bytes = width * channels * depth
    step = int(message.step) or row_bytes
    if len(data) < step * height or step < row_bytes:
        raise UnreadableImage(f"{where} is not a complete image")
    rows = np.frombuffer(data, dtype=np.uint8, count=step * height).reshape(height, step)[:, :row_bytes]
    pixels = np.ascontiguousarray(rows)
    if depth == 2:
        wide = pixels.view(">u2" if getattr(message, "is_bigendian", 0) else "<u2")
        pixels = (wide >> 8).astype(np.uint8)
    pixels = pixels.reshape(height, width, channels) if channels > 1 else pixels
    return pixels if conversion is None else cv2.cvtColor(pixels, conversion).astype(np.uint8, copy=False)
