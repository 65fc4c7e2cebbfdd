"""The shadow map around the vehicle: up to which height the sun is blocked."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bevcli.synth.render.raster_kernels import rasterise_heights


@dataclass(frozen=True)
class ShadowMap:
    """Heights of shadow over a square of the ground, in the world frame.

    A point (x, y, z) is in shadow where the height at (x, y) + z * shear exceeds z.

    Attributes:
        heights: (S, S) metres, rows along y; -1 where nothing blocks the sun.
        origin: x and y of the first texel's corner, metres.
        texel_m: size of a texel, metres.
        shear: distance in x and y that a shadow moves for each metre of height.
    """

    heights: NDArray[np.float32]
    origin: tuple[float, float]
    texel_m: float
    shear: tuple[float, float]

    @staticmethod
    def of(
        corners: NDArray[np.float32], to_sun: ArrayLike, center: ArrayLike, extent_m: float, texel_m: float
    ) -> ShadowMap:
        """The shadows of triangles on a square of `extent_m` metres around a world point.

        corners: (T, 3, 3) world, metres. to_sun: (3,) unit vector. center: (2,) metres; it is rounded to whole texels,
        so that the edges of shadows stay in place while the vehicle moves.
        """
        sun = np.asarray(to_sun, dtype=np.float64)
        shear = (float(-sun[0] / sun[2]), float(-sun[1] / sun[2]))
        size = round(extent_m / texel_m)
        low = np.asarray(center, dtype=np.float64) - extent_m / 2
        origin = (float(np.floor(low[0] / texel_m) * texel_m), float(np.floor(low[1] / texel_m) * texel_m))
        empty = ShadowMap(np.full((size, size), -1.0, np.float32), origin, texel_m, shear)
        return empty.with_shadows_of([corners])

    def with_shadows_of(self, parts: Iterable[NDArray[np.float32]]) -> ShadowMap:
        """A copy of the map with the shadows of more triangles. parts: arrays (T, 3, 3), world, metres."""
        heights = self.heights.copy()
        for corners in parts:
            rasterise_heights(corners, *self.shear, *self.origin, 1.0 / self.texel_m, heights)
        return replace(self, heights=heights)
