"""Resizes and normalises an image for the network, in one pass of compiled loops.

OpenCV's `resize` of the image as float32 gives the same numbers up to rounding, but takes up to four times as long: it
averages slowly, and writing the large image as float32 and normalising the result are passes of their own.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.transforms import Array
from bevcli.jit import njit

SMALLEST_OVERLAP = 1e-3  # pixels; OpenCV leaves out what overlaps less with the area of a pixel


@dataclass(frozen=True)
class Taps:
    """The pixels of a row (or column) that each of the n pixels of the resized one is a weighted mean of.

    Attributes:
        first: (n,) int64, index of the first of its K pixels.
        weights: (K, n) float32, those of its K pixels.
    """

    first: NDArray[np.int64]
    weights: NDArray[np.float32]

    def __getitem__(self, chosen: slice) -> Taps:
        """The taps of some of the n pixels."""
        return Taps(self.first[chosen], np.ascontiguousarray(self.weights[:, chosen]))


@lru_cache(maxsize=64)
def resize_taps(length: int, new_length: int, method: Literal["linear", "area"]) -> Taps:
    """The taps of a row of `length` pixels that is resized to `new_length`, as OpenCV's INTER_LINEAR or INTER_AREA."""
    scale, places = length / new_length, np.arange(new_length)[:, None]
    center = np.clip((places + 0.5) * scale - 0.5, 0, length - 1)

    def weigh(pixels: NDArray[np.int64]) -> Array:
        if method == "linear":
            return np.clip(1 - np.abs(pixels - center), 0, None)
        overlap = np.minimum(pixels + 1, (places + 1) * scale) - np.maximum(pixels, places * scale)
        return np.where(overlap > SMALLEST_OVERLAP, overlap / scale, 0)

    reach = int(np.ceil(scale / 2)) + 1
    near = np.floor(center).astype(np.int64) + np.arange(-reach, reach + 1)
    used = (weigh(near) > 0) & (near >= 0) & (near < length)
    first, count = np.take_along_axis(near, used.argmax(1)[:, None], 1), used.sum(1).max()
    first = np.minimum(first, length - count)
    weights = weigh(first + np.arange(count)).astype(np.float32)
    return Taps(first[:, 0], np.ascontiguousarray(weights.T))


def resize_and_normalize(
    pixels: NDArray[np.uint8],
    rows: Taps,
    columns: Taps,
    mean: NDArray[np.float32],
    std: NDArray[np.float32],
    out: NDArray[np.float32],
    *,
    reverse_channels: bool,
) -> None:
    """Writes the resized image, less `mean` and divided by `std`, to the top left corner of `out`.

    pixels: (H, W, 3) uint8. rows, columns: of the h rows and w columns of the result. mean, std: (3,) of the result's
    channels. out: (3, h or more, w or more). reverse_channels: whether the first channel becomes the last.
    """
    lines = np.ascontiguousarray(pixels).reshape(len(pixels), -1)
    if reverse_channels:
        mean, std, out = mean[::-1].copy(), std[::-1].copy(), out[::-1]
    _resample(lines, rows.first, rows.weights, columns.first, columns.weights, mean, std, out)


@njit(nogil=True, error_model="numpy", fastmath={"contract"})
def _resample(lines, first_row, row_weights, first_column, column_weights, mean, std, planes) -> None:  # type: ignore[no-untyped-def]
    """lines: (H, W * 3) uint8. planes: (3, h, w) float32, by the channels of `lines`."""
    mixed = np.empty(lines.shape[1], np.float32)  # a row of the result before its columns are resized
    for y in range(len(first_row)):
        mixed[:] = np.float32(0)
        for k in range(len(row_weights)):
            weight = row_weights[k, y]
            if weight > 0:
                line = lines[first_row[y] + k]
                for i in range(len(line)):
                    mixed[i] += weight * np.float32(line[i])
        for x in range(len(first_column)):
            first = second = third = np.float32(0)
            place = 3 * first_column[x]
            for k in range(len(column_weights)):
                weight = column_weights[k, x]
                first += weight * mixed[place]
                second += weight * mixed[place + 1]
                third += weight * mixed[place + 2]
                place += 3
            planes[0, y, x] = (first - mean[0]) / std[0]
            planes[1, y, x] = (second - mean[1]) / std[1]
            planes[2, y, x] = (third - mean[2]) / std[2]
