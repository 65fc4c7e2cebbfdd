"""Image files: their size and kind by the header, decoding of whole ones, encoding."""

import re
import struct
from collections.abc import Iterator
from io import BytesIO

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

JPEG_QUALITY = 90
# Markers of a JPEG that state its size (start of frame): all from C0 to CF except DHT, JPG and DAC.
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_PIXELS, _END = 0xDA, 0xD9
_MARKER = re.compile(rb"\xff[^\x00\x01\xd0-\xd8\xff]")  # those that have a length, and the end
OTHERS = ("WEBP", "TIFF", "BMP")  # formats that Pillow and OpenCV read


def media_type_of(encoded: bytes) -> str | None:
    """The media type of an encoded image: "image/jpeg", "image/png", or None for another format."""
    if encoded.startswith(b"\xff\xd8\xff"):
        return "image/jpeg"
    return "image/png" if encoded.startswith(b"\x89PNG\r\n\x1a\n") else None


def decode_image(encoded: bytes, flags: int, most_pixels: int) -> NDArray | None:
    """The pixels of a whole image file, as `cv2.imdecode` gives them.

    None for another format, a damaged or cut file, and for an image with more than `most_pixels` pixels.
    """
    size = size_of_image(encoded)
    if size is None or not 0 < size[0] * size[1] <= most_pixels or _is_cut_short(encoded):
        return None
    try:
        return cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), flags)
    except cv2.error:
        return None


def encode_image(pixels: NDArray, ending: str = ".jpg", quality: int = JPEG_QUALITY) -> bytes:
    """The file of an image with blue, green and red channels, or one channel. quality: of a JPEG, 1 to 100."""
    settings = [] if ending == ".png" else [cv2.IMWRITE_JPEG_QUALITY, quality]
    return cv2.imencode(ending, pixels, settings)[1].tobytes()


def size_of_image(encoded: bytes) -> tuple[int, int] | None:
    """(width, height) in pixels as the header of an image file states it; None where it states none."""
    media_type = media_type_of(encoded)
    if media_type == "image/png":
        if len(encoded) < 24 or encoded[12:16] != b"IHDR":
            return None
        width, height = struct.unpack(">II", encoded[16:24])
        return width, height
    if media_type == "image/jpeg":
        for marker, offset in _jpeg_markers(encoded):
            if marker in _FRAMES and offset + 7 <= len(encoded):
                height, width = struct.unpack(">HH", encoded[offset + 3 : offset + 7])
                return width, height
            if marker in _FRAMES or marker == _PIXELS:
                break
        return None
    try:
        with Image.open(BytesIO(encoded), formats=OTHERS) as image:
            return image.size
    except Exception:  # of many types for broken bytes
        return None


def _jpeg_markers(encoded: bytes) -> Iterator[tuple[int, int]]:
    """Each marker of a JPEG that has a length, or is the end, and the offset behind it."""
    offset = 2
    while marker := _MARKER.search(encoded, offset):
        yield encoded[marker.end() - 1], marker.end()
        offset = marker.end() + int.from_bytes(encoded[marker.end() : marker.end() + 2], "big")


def _is_cut_short(encoded: bytes) -> bool:
    """True if the end of a JPEG or PNG is missing. OpenCV fills it with grey, and allocates what a chunk states.

    Bytes after the end, such as the video of a motion photo, do not matter.
    """
    media_type = media_type_of(encoded)
    if media_type == "image/jpeg":
        return _END not in (marker for marker, _ in _jpeg_markers(encoded))  # a thumbnail's end lies in its segment
    if media_type is None:
        return False  # OpenCV refuses those of the other formats
    offset = 8
    while offset + 12 <= len(encoded):  # a chunk of a PNG: length, kind, contents, checksum
        chunk = encoded[offset + 4 : offset + 8]
        offset += 12 + int.from_bytes(encoded[offset : offset + 4], "big")
        if chunk == b"IEND":
            return offset > len(encoded)
    return True
