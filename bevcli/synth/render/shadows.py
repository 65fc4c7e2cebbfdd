"""The shadow map around the vehicle: where the sun's light is blocked, and how high."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bevcli.synth.render.rasteriser import add_heights_from_sun
from bevcli.synth.render.shading import ShadowMap


def shadow_map(
    parts: Iterable[NDArray[np.float32]], to_sun: ArrayLike, center: ArrayLike, extent_m: float, texel_m: float
) -> ShadowMap:
    """The shadows of triangles (T, 3, 3) in world metres over a square around a world point (2,).

    Texels lie at the same places of the world for all centres, so that shadows do not crawl while the vehicle moves.
    """
    sun = np.asarray(to_sun, dtype=np.float64)
    shear = (float(-sun[0] / sun[2]), float(-sun[1] / sun[2]))
    size = round(extent_m / texel_m)
    low = np.asarray(center, dtype=np.float64) - extent_m / 2
    origin = (float(np.floor(low[0] / texel_m) * texel_m), float(np.floor(low[1] / texel_m) * texel_m))
    heights = np.full((size, size), -1.0, np.float32)
    for corners in parts:
        add_heights_from_sun(corners, shear, origin, texel_m, heights)
    return ShadowMap(heights, origin, texel_m, shear)


def with_more(shadows: ShadowMap, parts: Iterable[NDArray[np.float32]]) -> ShadowMap:
    """The map with the shadows of more triangles (T, 3, 3) in it; the given map stays as it is."""
    heights = shadows.heights.copy()
    for corners in parts:
        add_heights_from_sun(corners, shadows.shear, shadows.origin, shadows.texel_m, heights)
    return replace(shadows, heights=heights)
