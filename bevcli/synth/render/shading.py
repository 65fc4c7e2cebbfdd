"""Shading: a visibility buffer -> an image, each pixel once, with sun shadows, windows, reflections and haze.

Light is linear; surfaces answer as matte reflectors, glass and paint also mirror the sky. The ground needs no
triangles: a pixel that sees none and looks down sees the plane z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array
from bevcli.synth.assets.paint import display_table
from bevcli.synth.render.ground_texture import GroundTexture
from bevcli.synth.render.rasteriser import VisibilityBuffer
from bevcli.synth.render.shading_kernels import LIGHT_LIMIT, shade_pixels
from bevcli.synth.world.weather import Weather


@dataclass(frozen=True)
class Surfaces:
    """The triangles of a scene. corners, normals, albedo: (T, 3, 3), (T, 3), (T, 3) float32, world, linear.

    material: (T,) uint8. facade: (T,) int32 row of `facades`, -1 for none. facades: (K, 16) float32.
    """

    corners: NDArray[np.float32]
    normals: NDArray[np.float32]
    albedo: NDArray[np.float32]
    material: NDArray[np.uint8]
    facade: NDArray[np.int32]
    facades: NDArray[np.float32]


@dataclass(frozen=True)
class ShadowMap:
    """heights: (S, S) of `heights_from_sun`. origin: (x, y) metres of its first corner. texel_m, shear as there."""

    heights: NDArray[np.float32]
    origin: tuple[float, float]
    texel_m: float
    shear: tuple[float, float]


def shade(
    buffer: VisibilityBuffer,
    surfaces: Surfaces,
    ground: GroundTexture,
    shadows: ShadowMap,
    weather: Weather,
    camera: Camera,
    world_from_camera: Array,
) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 BGR image of what the visibility buffer of this camera (without distortion) saw."""
    w = weather
    light = np.stack([w.sun, w.sky, w.bounce, w.zenith, w.horizon, w.haze, w.cloud_color]).astype(np.float64)
    ray_from_image = world_from_camera[:3, :3] @ np.linalg.inv(camera.intrinsics)
    image = np.empty((*buffer.triangles.shape, 3), np.uint8)
    shade_pixels(
        (buffer.triangles, buffer.inverse_depth),
        (surfaces.normals, surfaces.albedo, surfaces.material, surfaces.facade, surfaces.facades),
        (ground.texels, ground.offsets, ground.rough, *ground.origin, ground.texel_m, ground.size),
        (shadows.heights, *shadows.origin, shadows.texel_m, *shadows.shear, w.shadow_softness_m),
        (light, w.to_sun, w.clouds, w.haze_m, w.lamps),
        (ray_from_image, np.ascontiguousarray(world_from_camera[:3, 3]), 1.0 / camera.intrinsics[0, 0]),
        display_table(limit=LIGHT_LIMIT),
        image,
    )
    return image
