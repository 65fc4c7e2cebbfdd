"""Shading: from a visibility buffer to an image, with sun shadows, windows, reflections and haze.

Each pixel is shaded once, in linear RGB. All surfaces are diffuse; glass and paint also reflect the sky. The ground has
no triangles: a pixel that sees none and looks down sees the plane z = 0.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array
from bevcli.synth.assets.triangles import Triangles
from bevcli.synth.render.ground_texture import GroundTexture
from bevcli.synth.render.rasteriser import VisibilityBuffer
from bevcli.synth.render.shading_kernels import LIGHT_LIMIT, shade_pixels
from bevcli.synth.render.shadow_map import ShadowMap
from bevcli.synth.world.weather import Weather

TABLE_SIZE = 4096


def shade(
    buffer: VisibilityBuffer,
    triangles: Triangles,
    ground: GroundTexture,
    shadows: ShadowMap,
    weather: Weather,
    camera: Camera,
    world_from_camera: Array,
) -> NDArray[np.uint8]:
    """Colour a visibility buffer. Returns (H, W, 3) uint8 BGR.

    camera: the buffer's camera; its distortion is ignored. world_from_camera: (4, 4).
    """
    w = weather
    light = np.stack([w.sun, w.sky, w.bounce, w.zenith, w.horizon, w.haze, w.cloud_color]).astype(np.float64)
    ray_from_image = world_from_camera[:3, :3] @ np.linalg.inv(camera.intrinsics)
    image = np.empty((*buffer.triangles.shape, 3), np.uint8)
    shade_pixels(
        (buffer.triangles, buffer.inverse_depth),
        (triangles.normals, triangles.albedo, triangles.material, triangles.facade, triangles.facades),
        (ground.texels, ground.offsets, ground.rough, *ground.origin, ground.texel_m, ground.size),
        (shadows.heights, *shadows.origin, shadows.texel_m, *shadows.shear, w.shadow_softness_m),
        (light, w.to_sun, w.clouds, w.haze_m, w.lamps),
        (ray_from_image, np.ascontiguousarray(world_from_camera[:3, 3]), 1.0 / camera.intrinsics[0, 0]),
        _display_table(),
        image,
    )
    return image


@lru_cache(maxsize=1)
def _display_table() -> NDArray[np.uint8]:
    """(TABLE_SIZE,) sRGB bytes of linear light from 0 to LIGHT_LIMIT. Light above 0.7 is compressed smoothly."""
    light = np.linspace(0, LIGHT_LIMIT, TABLE_SIZE)
    shoulder = 0.7
    rolled = shoulder + (1 - shoulder) * (1 - np.exp(-(light - shoulder) / (1 - shoulder)))
    mapped = np.where(light < shoulder, light, rolled)
    encoded = np.where(mapped <= 0.0031308, 12.92 * mapped, 1.055 * mapped ** (1 / 2.4) - 0.055)
    return np.clip(np.round(encoded * 255), 0, 255).astype(np.uint8)
