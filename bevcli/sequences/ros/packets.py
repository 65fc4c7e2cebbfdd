"""Video packets in a bag (Foxglove's CompressedVideo) -> images.

OpenCV decodes files only. So the packets from a keyframe to the next are written to a temporary file, and read from it.
"""

from __future__ import annotations

import struct
import tempfile
import threading
from pathlib import Path

from bevcli.errors import InputError
from bevcli.frame import CameraImage
from bevcli.sequences.images import UnreadableImage
from bevcli.sequences.ros.bag import Bag
from bevcli.sequences.ros.messages import payload, timestamp_ns
from bevcli.sequences.video import VideoReader

IVF_CODES = {"vp9": b"VP90", "av1": b"AV01"}
RAW_FORMATS = ("h264", "h265")
LONGEST_GROUP = 600  # packets from one keyframe to the next


class BagVideo:
    """The images of a topic with video packets. In order, each packet is decoded once.

    Raises InputError for a format that is not supported.
    """

    def __init__(self, bag: Bag, topic: str) -> None:
        self._bag, self._topic = bag, topic
        self._count = len(bag.times(topic))
        self._format = str(bag.message(topic, 0).format).lower()
        if self._format not in (*IVF_CODES, *RAW_FORMATS):
            expected = ", ".join((*RAW_FORMATS, *IVF_CODES))
            raise InputError(f"{bag.path}: {topic}: video format {self._format} is not supported (expected {expected})")
        self._folder = tempfile.TemporaryDirectory(prefix="bevcli-video-")
        self._group: range = range(0)  # messages of the group of pictures that is open
        self._reader: VideoReader | None = None
        self._lock = threading.Lock()

    def image(self, index: int, time_ns: int) -> PacketImage:
        """The source of image `index`. time_ns: according to the index of the bag."""
        return PacketImage(self, index, time_ns)

    def read(self, index: int, time_ns: int) -> CameraImage:
        """Image `index`. Raises UnreadableImage if it cannot be decoded."""
        with self._lock:
            try:
                if index not in self._group:
                    self._open_group(index)
                assert self._reader is not None
                pixels = self._reader.read(index - self._group.start)
                time = timestamp_ns(self._bag.message(self._topic, index)) or time_ns
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
        while stop < self._count and not is_keyframe(self._packet(stop), self._format):
            stop += 1
        path = Path(self._folder.name) / f"{start}.{'ivf' if self._format in IVF_CODES else self._format}"
        path.write_bytes(_file_of([self._packet(number) for number in range(start, stop)], self._format))
        if self._reader is not None:
            self._reader.path.unlink(missing_ok=True)
        self._reader, self._group = VideoReader(path), range(start, stop)

    def _packet(self, index: int) -> bytes:
        return payload(self._bag.message(self._topic, index))


class PacketImage:
    """One image of a `BagVideo`, decoded on demand.

    Attributes:
        timestamp_ns: its time according to the index of the bag.
    """

    def __init__(self, video: BagVideo, index: int, time_ns: int) -> None:
        self._video, self._index = video, index
        self.timestamp_ns = time_ns

    def read(self) -> CameraImage:
        """The image. Raises UnreadableImage."""
        return self._video.read(self._index, self.timestamp_ns)


def is_keyframe(packet: bytes, video_format: str) -> bool:
    """Whether decoding can start at a packet. Foxglove's schema puts parameter sets before each keyframe."""
    if video_format == "vp9":
        return bool(packet) and _is_vp9_keyframe(packet[0])
    if video_format == "av1":
        return bool(packet) and any(kind == 1 for kind in _av1_units(packet))  # a sequence header
    for kind in _nal_headers(packet):
        if (kind & 0x1F) == 7 if video_format == "h264" else ((kind >> 1) & 0x3F) in (32, 33):
            return True  # a parameter set
    return False


def _nal_headers(packet: bytes) -> list[int]:
    """The first byte of every NAL unit of H.264 or H.265 in Annex B."""
    headers = []
    at = packet.find(b"\x00\x00\x01")
    while 0 <= at < len(packet) - 3:
        headers.append(packet[at + 3])
        at = packet.find(b"\x00\x00\x01", at + 3)
    return headers


def _is_vp9_keyframe(first: int) -> bool:
    """From the uncompressed header: frame marker (2 bits), profile (2 or 3), show_existing_frame, frame_type."""
    profile = ((first >> 5) & 1) | ((first >> 3) & 2)
    shift = 3 if profile < 3 else 2
    return not (first >> shift) & 1 and not (first >> (shift - 1)) & 1


def _av1_units(packet: bytes) -> list[int]:
    """The types of the open bitstream units of an AV1 packet."""
    kinds = []
    at = 0
    while at < len(packet):
        head = packet[at]
        kinds.append((head >> 3) & 0xF)
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
    return kinds


def _file_of(packets: list[bytes], video_format: str) -> bytes:
    """The bytes of a video file: Annex B as it is, VP9 and AV1 in an IVF container."""
    if video_format not in IVF_CODES:
        return b"".join(packets)
    # Width and height are not used by the decoder; 30 images per second.
    head = struct.pack("<4sHH4sHHIIII", b"DKIF", 0, 32, IVF_CODES[video_format], 0, 0, 30, 1, len(packets), 0)
    frames = (struct.pack("<IQ", len(packet), number) + packet for number, packet in enumerate(packets))
    return head + b"".join(frames)
