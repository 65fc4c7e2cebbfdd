"""The size of a JPEG or PNG from its header, before anything is decoded."""

from __future__ import annotations

import struct

# Markers of a JPEG that state its size (start of frame): all from C0 to CF except DHT, JPG and DAC.
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_WITHOUT_LENGTH = frozenset(range(0xD0, 0xD9)) | {0x01}


def media_type_of(encoded: bytes) -> str | None:
    """The media type of an encoded image: "image/jpeg", "image/png", or None for another format."""
    if encoded.startswith(b"\xff\xd8\xff"):
        return "image/jpeg"
    return "image/png" if encoded.startswith(b"\x89PNG\r\n\x1a\n") else None


def size_of_image(encoded: bytes) -> tuple[int, int] | None:
    """(width, height) in pixels as the header of a JPEG or PNG states it; None where it states none."""
    kind = media_type_of(encoded)
    if kind == "image/png":
        if len(encoded) < 24 or encoded[12:16] != b"IHDR":
            return None
        width, height = struct.unpack(">II", encoded[16:24])
        return width, height
    return _jpeg_size(encoded) if kind == "image/jpeg" else None


def _jpeg_size(encoded: bytes) -> tuple[int, int] | None:
    place = 2
    while True:
        place = encoded.find(b"\xff", place)
        while place >= 0 and encoded[place : place + 1] == b"\xff":  # markers may be padded
            place += 1
        if place < 0 or place + 3 > len(encoded):
            return None
        marker = encoded[place]
        place += 1
        if marker in _FRAMES:
            if place + 7 > len(encoded):
                return None
            height, width = struct.unpack(">HH", encoded[place + 3 : place + 7])
            return width, height
        if marker == 0xDA:  # the pixels begin, and no size was stated
            return None
        if marker and marker not in _WITHOUT_LENGTH:
            place += max(2, int.from_bytes(encoded[place : place + 2], "big"))
