"""Decompresses zstd and LZ4 up to a limit: a few kilobytes can state gigabytes."""

from __future__ import annotations


def decompressed(kind: str, data: bytes, largest: int) -> bytes:
    """The bytes of compressed data.

    kind: "zstd", "lz4", or "" for data that is not compressed.
    Raises ValueError for another kind, damaged data, or more than `largest` bytes. Data that is cut off may give less.
    """
    if kind == "zstd":
        found = _from_zstd(data, largest + 1)
    elif kind == "lz4":
        found = _from_lz4(data, largest + 1)
    elif kind == "":
        found = data
    else:
        raise ValueError(f'unknown compression "{kind:.20}" (expected zstd, lz4 or none)')
    if len(found) > largest:
        raise ValueError(f"has more than {largest} bytes when it is decompressed")
    return found


def _from_zstd(data: bytes, largest: int) -> bytes:
    import zstandard

    try:
        return zstandard.ZstdDecompressor().stream_reader(data).read(largest)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from None


def _from_lz4(data: bytes, largest: int) -> bytes:
    import lz4.frame  # type: ignore[import-not-found,import-untyped,unused-ignore]

    try:
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, largest))
    except (RuntimeError, EOFError) as error:
        raise ValueError(str(error)) from None
