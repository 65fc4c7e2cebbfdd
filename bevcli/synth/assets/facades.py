"""Facades: windows, floors and shop fronts as a function of where on the wall a pixel looks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.synth.assets.paint import Color, linear


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
    """(16,) numbers that describe one wall for the shading kernel. origin, tangent: (2,) world, seen from outside."""
    wall = linear(style.wall)
    return np.array(
        [*origin, *tangent, height, length, style.floor_m, style.pitch_m, *style.window_m, style.shop_m, style.brick,
         float(style.band) + 2.0 * (style.seed % 4096), *wall], np.float32,
    )  # fmt: skip
