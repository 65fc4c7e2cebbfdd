"""Image messages -> pixels: compressed files, raw pixels in ROS's encodings, and video packets.

OpenCV decodes files only. So the packets from a keyframe to the next are written to a temporary file, and read from it.
"""

import re
import struct
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import CameraImage
from bevcli.parsing.images import decode_image, media_type_of, size_of_image
from bevcli.printing import one_line
from bevcli.sequences.images import MOST_PIXELS, MessageSource, UnreadableImage, VideoReader, decode
from bevcli.workshop.formats.ros.bag import Bag
from bevcli.workshop.formats.ros.messages import payload, timestamp_ns

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
BAYER = re.compile("bayer_(rggb|bggr|gbrg|grbg)(8|16)")
COMPRESSED = re.compile("jpe?g|png|webp|tiff?|bmp", re.I)  # in the name of a format; "compressedDepth" is another one
IVF_CODES = {"vp9": b"VP90", "av1": b"AV01"}
RAW_FORMATS = ("h264", "h265")
LONGEST_GROUP = 600  # packets from one keyframe to the next


def bag_image(bag: Bag, topic: str, numbers: NDArray[np.int64], index: int, time_ns: int) -> MessageSource:
    """Image `index` of a topic, read on demand. numbers: (N,) of its messages in order of capture. time_ns: roughly."""
    number = int(numbers[index])
    name = f"{bag.path}: {topic}: message {number}"
    return MessageSource(name, time_ns, lambda: _read_message(bag, topic, number, time_ns, name))


def _read_message(bag: Bag, topic: str, index: int, time_ns: int, name: str) -> CameraImage:
    """The image, with the time that its message states.

    Raises UnreadableImage if it is broken, and InputError for an unknown encoding or format.
    """
    try:
        message = bag.message(topic, index)
    except InputError as error:
        raise UnreadableImage(str(error)) from None
    time, data = timestamp_ns(message) or time_ns, payload(message)
    if hasattr(message, "encoding"):
        return CameraImage(time, _raw_pixels(message, data, name))
    stated = str(getattr(message, "format", ""))
    pixels, is_as_stored = _decoded(data, stated)
    if pixels is None and stated and size_of_image(data) is None and not COMPRESSED.search(stated):
        raise InputError(
            f"{bag.path}: {topic}: images of format {one_line(stated, 60)} are not read (expected JPEG, PNG, WebP, "
            "TIFF or BMP, or video as foxglove.CompressedVideo): write the topic in one of these"
        )
    if pixels is None:
        raise UnreadableImage(f"{name} is not a complete image")
    media_type = media_type_of(data) if is_as_stored else None
    return CameraImage(time, pixels, data if media_type else None, media_type)


def _decoded(data: bytes, stated: str) -> tuple[NDArray[np.uint8] | None, bool]:
    """(H, W, 3) uint8 BGR of a compressed image, None for a broken one; False if the file shows other colours.

    stated: the format. After "compressed", ROS's image_transport names the encoding of what OpenCV compressed as if it
    were BGR or grey, such as in "rgb8; png compressed rgb8" and "bayer_rggb8; jpeg compressed ".
    """
    before, _, after = stated.partition("compressed")
    encoding = after.strip() or before.partition(";")[0]
    pixels = decode_image(data, cv2.IMREAD_UNCHANGED, MOST_PIXELS) if BAYER.fullmatch(encoding) else None
    if pixels is not None and pixels.ndim == 2:
        pixels = pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)
        return cv2.cvtColor(pixels, RAW_ENCODINGS[encoding][2] or 0).astype(np.uint8, copy=False), False
    pixels = decode(data)
    if pixels is None or not (after.strip() and encoding.startswith("rgb")):
        return pixels, True
    return pixels[..., ::-1].copy(), False


def _raw_pixels(message: Any, data: bytes, where: str) -> NDArray[np.uint8]:
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


class BagVideo:
    """The images of a topic with video packets. In order, each packet is decoded once.

    Raises InputError for a format that is not supported.
    """

    def __init__(self, bag: Bag, topic: str, numbers: NDArray[np.int64]) -> None:
        """numbers: (N,) of the topic's messages in order of capture."""
        self._bag, self._topic, self._numbers = bag, topic, numbers.tolist()
        self._format = str(bag.message(topic, 0).format).lower()
        if self._format not in (*IVF_CODES, *RAW_FORMATS):
            expected = ", ".join((*RAW_FORMATS, *IVF_CODES))
            raise InputError(f"{bag.path}: {topic}: video format {self._format} is not supported (expected {expected})")
        self._folder = tempfile.TemporaryDirectory(prefix="bevcli-video-")
        self._group: range = range(0)  # messages of the group of pictures that is open
        self._reader: VideoReader | None = None
        self._lock = threading.Lock()

    def image(self, index: int, time_ns: int) -> MessageSource:
        """The source of image `index`. time_ns: according to the index of the bag."""
        name = f"{self._bag.path}: {self._topic}: message {self._numbers[index]}"
        return MessageSource(name, time_ns, lambda: self.read(index, time_ns))

    def read(self, index: int, time_ns: int) -> CameraImage:
        """Image `index`. Raises UnreadableImage if it cannot be decoded."""
        with self._lock:
            try:
                if index not in self._group:
                    self._open_group(index)
                assert self._reader is not None
                pixels = self._reader.read(index - self._group.start)
                time = timestamp_ns(self._bag.message(self._topic, self._numbers[index])) or time_ns
            except InputError as error:
                raise UnreadableImage(f"{self._topic}: image {index} cannot be decoded ({error})") from None
        return CameraImage(time, pixels)

    def _open_group(self, index: int) -> None:
        start = index
        while not is_keyframe(self._packet(start), self._format):
            start -= 1
            if start < 0 or index - start > LONGEST_GROUP:
                raise InputError("there is no keyframe before it")
        stop = index + 1
        while stop < len(self._numbers) and not is_keyframe(self._packet(stop), self._format):
            stop += 1
        path = Path(self._folder.name) / f"{start}.{'ivf' if self._format in IVF_CODES else self._format}"
        path.write_bytes(_file_of([self._packet(number) for number in range(start, stop)], self._format))
        if self._reader is not None:
            self._reader.path.unlink(missing_ok=True)
        self._reader, self._group = VideoReader(path), range(start, stop)

    def _packet(self, index: int) -> bytes:
        return payload(self._bag.message(self._topic, self._numbers[index]))


def is_keyframe(packet: bytes, video_format: str) -> bool:
    """True for a packet at which decoding can start. Foxglove's schema puts parameter sets before each keyframe."""
    if video_format == "vp9":
        return bool(packet) and _is_vp9_keyframe(packet[0])
    if video_format == "av1":
        return 1 in _av1_units(packet)  # a sequence header
    heads = [unit[0] for unit in packet.split(b"\x00\x00\x01")[1:] if unit]  # first bytes of NAL units in Annex B
    if video_format == "h264":
        return any(head & 0x1F == 7 for head in heads)  # a parameter set, as for H.265
    return any(head >> 1 & 0x3F in (32, 33) for head in heads)


def _is_vp9_keyframe(first: int) -> bool:
    """From the uncompressed header: frame marker (2 bits), profile (2 or 3), show_existing_frame, frame_type."""
    profile = ((first >> 5) & 1) | ((first >> 3) & 2)
    shift = 3 if profile < 3 else 2
    return not (first >> shift) & 1 and not (first >> (shift - 1)) & 1


def _av1_units(packet: bytes) -> Iterator[int]:
    """The types of the open bitstream units of an AV1 packet."""
    at = 0
    while at < len(packet):
        head = packet[at]
        yield (head >> 3) & 0xF
        at += 2 if head & 4 else 1
        if not head & 2:
            break
        size, shift = 0, 0
        while at < len(packet):
            size |= (packet[at] & 0x7F) << shift
            shift += 7
            at += 1
            if not packet[at - 1] & 0x80:
                break
        at += size


def _file_of(packets: list[bytes], video_format: str) -> bytes:
    """The bytes of a video file: Annex B as it is, VP9 and AV1 in an IVF container."""
    if video_format not in IVF_CODES:
        return b"".join(packets)
    # Width and height are not used by the decoder; 30 images per second.
    head = struct.pack("<4sHH4sHHIIII", b"DKIF", 0, 32, IVF_CODES[video_format], 0, 0, 30, 1, len(packets), 0)
    frames = (struct.pack("<IQ", len(packet), number) + packet for number, packet in enumerate(packets))
    return head + b"".join(frames)
