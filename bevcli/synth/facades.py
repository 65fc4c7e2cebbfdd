"""Facades: windows, floors and shop fronts as a function of where on the wall a pixel looks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from bevcli.synth.palette import Color, linear


@dataclass(frozen=True)
class FacadeStyle:
    """A wall's look. Metres; `pitch` is the distance between windows, `shop` the height of a glazed ground floor.

    brick: strength of brick courses, 0 for plaster. band: whether windows join to horizontal bands.
    """

    wall: Color
    floor_m: float
    pitch_m: float
    window_m: tuple[float, float]
    shop_m: float
    brick: float
    band: bool
    seed: int


def facade_row(
    style: FacadeStyle, origin: NDArray[np.float64], tangent: NDArray[np.float64], height: float, length: float
) -> NDArray[np.float32]:
    """(16,) numbers that describe one wall for `facade_albedo`. origin, tangent: (2,) world, seen from outside."""
    wall = linear(style.wall)
    return np.array(
        [*origin, *tangent, height, length, style.floor_m, style.pitch_m, *style.window_m, style.shop_m, style.brick,
         float(style.band) + 2.0 * (style.seed % 4096), *wall], np.float32,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def facade_albedo(row, x, y, z, footprint, lamps, out):
    """Albedo of the wall `row` at a world point into out (3,); returns whether the point is glass.

    footprint: metres that a pixel spans there; detail that is finer fades into its mean.
    """
    u = (x - row[0]) * row[2] + (y - row[1]) * row[3]
    height, length = row[4], row[5]
    floor_m, pitch, window_w, window_h, shop_m, brick = row[6], row[7], row[8], row[9], row[10], row[11]
    coded = int(row[12])
    band, seed = coded % 2 == 1, coded // 2
    out[0], out[1], out[2] = row[13], row[14], row[15]
    if z > height - 0.7:  # cornice
        shade = 0.8 if z > height - 0.2 or z < height - 0.6 else 1.12
        for c in range(3):
            out[c] *= shade
        return False
    if z < shop_m and shop_m < 1.0:  # a plinth of stone
        out[0], out[1], out[2] = 0.5 * out[0] + 0.08, 0.5 * out[1] + 0.08, 0.5 * out[2] + 0.08
        return False
    if z < shop_m:
        return _shop(u, z, length, shop_m, seed, out)
    floors = np.floor((height - 0.9 - shop_m) / floor_m)
    storey = np.floor((z - shop_m) / floor_m)
    columns = max(1.0, np.floor((length - 0.8) / pitch))
    margin = (length - columns * pitch) / 2
    column = np.floor((u - margin) / pitch)
    inside = 0 <= column < columns and storey < floors
    wu = u - margin - column * pitch - pitch / 2
    wv = z - shop_m - storey * floor_m - floor_m * 0.52
    if brick > 0:
        _courses(u, z, footprint, brick, out)
    if not inside:
        return False
    if band:
        glass = abs(wv) < window_h / 2
        frame = abs(wu) > pitch / 2 - 0.06
    else:
        glass = abs(wu) < window_w / 2 and abs(wv) < window_h / 2
        frame = (
            abs(wu) < 0.035
            or abs(wu) > window_w / 2 - 0.07
            or abs(wv) > window_h / 2 - 0.07
        )
        if abs(wu) < window_w / 2 + 0.12 and -window_h / 2 - 0.16 < wv < -window_h / 2:  # sill
            for c in range(3):
                out[c] = out[c] * 0.5 + 0.34
            return False
        if abs(wu) < window_w / 2 + 0.05 and window_h / 2 < wv < window_h / 2 + 0.18:  # lintel
            for c in range(3):
                out[c] *= 0.72
            return False
    if not glass:
        return False
    if frame and footprint < 0.12:
        out[0], out[1], out[2] = 0.5, 0.5, 0.48
        return False
    _pane(seed, int(column), int(storey), wv / window_h, lamps, out)
    return True


@njit(cache=True, nogil=True)
def _courses(u, z, footprint, brick, out):
    """Mortar joints and bricks of uneven tone, where a pixel is fine enough to show them."""
    strength = brick * min(1.0, max(0.0, (0.09 - footprint) / 0.06))
    if strength <= 0:
        return
    course = int(np.floor(z / 0.09))
    shifted = u / 0.26 + 0.5 * (course % 2)
    along = int(np.floor(shifted))
    tone = (scramble(along, course) % 64) / 64.0 - 0.5
    joint = z / 0.09 - course < 0.16 or shifted - along < 0.06
    factor = 1.0 + strength * (0.35 * tone + (0.35 if joint else 0.0))
    for c in range(3):
        out[c] *= factor


@njit(cache=True, nogil=True)
def _pane(seed, column, storey, up, lamps, out):
    """What is behind a window: dark rooms, a curtain, or a lamp."""
    chance = scramble(seed + column * 7919, storey * 104729 + seed) % 100
    out[0], out[1], out[2] = 0.035, 0.045, 0.055
    if chance < 26 and up > -0.5 + (chance % 5) * 0.2:  # curtain or blind
        out[0], out[1], out[2] = 0.32, 0.30, 0.26
    elif chance > 100 - 30 * (lamps - 0.4):
        out[0], out[1], out[2] = 1.5, 1.1, 0.6


@njit(cache=True, nogil=True)
def _shop(u, z, length, shop_m, seed, out):
    """The ground floor: a plinth, panes between posts, doors, and a coloured sign above."""
    unit = 4.2
    count = max(1.0, np.floor(length / unit))
    width = length / count
    index = int(np.floor(u / width))
    wu = u - index * width
    kind = scramble(seed + 31 * index, seed) % 5
    if z > shop_m - 0.75:
        if z > shop_m - 0.68 and 0.25 < wu < width - 0.25:
            pick = scramble(index + 5, seed) % 6
            out[0] = 0.30 if pick in (0, 3) else 0.07
            out[1] = 0.20 if pick in (1, 3, 4) else 0.06
            out[2] = 0.22 if pick in (2, 4) else 0.07
        return False
    if wu < 0.25 or wu > width - 0.25 or z < 0.45 and kind != 0:
        for c in range(3):
            out[c] *= 0.7
        return False
    if kind == 4:  # a closed front
        stripe = z * 8 - np.floor(z * 8) < 0.15
        for c in range(3):
            out[c] = (0.16 if stripe else 0.24) + 0.02 * c
        return False
    if abs(wu - width / 2) < 0.05 or kind == 0 and abs(wu - width * 0.7) < 0.04:
        out[0], out[1], out[2] = 0.08, 0.08, 0.09
        return False
    out[0], out[1], out[2] = 0.06, 0.065, 0.07
    if z < 1.3 and kind != 0:  # goods behind the glass
        tone = scramble(int(np.floor(u * 2.5)), seed + int(z * 3)) % 7
        out[0], out[1], out[2] = 0.05 + 0.03 * tone, 0.06 + 0.02 * (6 - tone), 0.10
    return True


@njit(cache=True, nogil=True, inline="always")
def scramble(a, b):
    """A small integer hash of two integers, 0 to 2^31 - 1."""
    h = (a * 73856093) ^ (b * 19349663)
    h = (h ^ (h >> 13)) * 1274126177
    return (h ^ (h >> 16)) & 0x7FFFFFFF
