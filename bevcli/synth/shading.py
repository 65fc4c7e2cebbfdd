"""Shading: a visibility buffer -> a picture, each pixel once, with sun shadows, windows, reflections and haze.

Light is linear; surfaces answer as matte reflectors, glass and paint also mirror the sky. The ground needs no
triangles: a pixel that sees none and looks down sees the plane z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array
from bevcli.synth.facades import facade_albedo
from bevcli.synth.ground_texture import GroundTexture, sample_ground
from bevcli.synth.mesh import Material
from bevcli.synth.palette import display_table
from bevcli.synth.rasteriser import VisibilityBuffer
from bevcli.synth.weather import Weather

LIGHT_LIMIT = 1.6  # brightest light that the display table distinguishes
GROUND, FACADE, GLASS, PAINT, GLOW = (
    int(m) for m in (Material.GROUND, Material.FACADE, Material.GLASS, Material.PAINT, Material.GLOW)
)


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
    """(H, W, 3) uint8 BGR picture of what the visibility buffer of this camera (without distortion) saw."""
    w = weather
    light = np.stack([w.sun, w.sky, w.bounce, w.zenith, w.horizon, w.haze, w.cloud_color]).astype(np.float64)
    ray_from_image = world_from_camera[:3, :3] @ np.linalg.inv(camera.intrinsics)
    picture = np.empty((*buffer.triangles.shape, 3), np.uint8)
    _shade(
        buffer.triangles, buffer.inverse_depth, surfaces.normals, surfaces.albedo, surfaces.material,
        surfaces.facade, surfaces.facades,
        ground.texels, ground.offsets, ground.rough, ground.origin[0], ground.origin[1], ground.texel_m, ground.size,
        shadows.heights, shadows.origin[0], shadows.origin[1], shadows.texel_m, shadows.shear[0], shadows.shear[1],
        light, w.to_sun, w.clouds, w.haze_m, w.lamps, w.shadow_softness_m,
        ray_from_image, np.ascontiguousarray(world_from_camera[:3, 3]), 1.0 / camera.intrinsics[0, 0],
        display_table(limit=LIGHT_LIMIT), picture,
    )  # fmt: skip
    return picture


@njit(cache=True, nogil=True, error_model="numpy")
def _shade(triangles, inverse_depth, normals, albedo, material, facade, facades,
           texels, offsets, rough, ground_x, ground_y, texel_m, ground_size,
           heights, shadow_x, shadow_y, shadow_texel, shear_x, shear_y,
           light, to_sun, clouds, haze_m, lamps, softness,
           ray_from_image, eye, pixel_angle, table, picture):  # fmt: skip
    height, width = triangles.shape
    sun, sky, bounce, haze = light[0], light[1], light[2], light[5]
    a = np.empty(3)  # albedo, then colour
    mirror = np.empty(3)
    table_scale = (table.shape[0] - 1) / LIGHT_LIMIT
    for v in range(height):
        for u in range(width):
            rx = ray_from_image[0, 0] * u + ray_from_image[0, 1] * v + ray_from_image[0, 2]
            ry = ray_from_image[1, 0] * u + ray_from_image[1, 1] * v + ray_from_image[1, 2]
            rz = ray_from_image[2, 0] * u + ray_from_image[2, 1] * v + ray_from_image[2, 2]
            length = np.sqrt(rx * rx + ry * ry + rz * rz)
            t = triangles[v, u]
            kind = GROUND
            nx, ny, nz = 0.0, 0.0, 1.0
            if t >= 0:
                z = 1.0 / inverse_depth[v, u]
                kind = material[t]
                nx, ny, nz = normals[t, 0], normals[t, 1], normals[t, 2]
            elif rz < -1e-4 * length:
                z = -eye[2] / rz
            else:
                _sky(rx / length, ry / length, rz / length, light, to_sun, clouds, a)
                _put(picture, v, u, a, table, table_scale)
                continue
            px, py, pz = eye[0] + z * rx, eye[1] + z * ry, eye[2] + z * rz
            distance = z * length
            footprint = z * pixel_angle
            grain = 0.0
            if kind == GROUND:
                grazing = max(-rz / length, 0.02)
                grain = sample_ground(texels, offsets, rough, ground_x, ground_y, texel_m, ground_size,
                                      px, py, footprint, footprint / grazing, rx, ry, a)  # fmt: skip
            elif kind == FACADE:
                if facade_albedo(facades[facade[t]], px, py, pz, footprint, lamps, a):
                    kind = GLASS
            else:
                a[0], a[1], a[2] = albedo[t, 0], albedo[t, 1], albedo[t, 2]
            if kind == GLOW:
                for c in range(3):
                    a[c] *= 0.35 + 0.65 * lamps
            else:
                lit = nx * to_sun[0] + ny * to_sun[1] + nz * to_sun[2]
                if lit > 0:
                    off = 0.02 + 1.6 * shadow_texel * (1.0 - lit)  # look from a little outside, or surfaces shade themselves
                    sz = pz + off * nz
                    lit *= 1.0 - _shadow(heights, px + off * nx + shear_x * sz, py + off * ny + shear_y * sz, sz,
                                         shadow_x, shadow_y, shadow_texel, softness)  # fmt: skip
                else:
                    lit = 0.0
                up = 0.5 + 0.5 * nz
                near_ground = 1.0
                if t >= 0 and nz < 0.5:  # less sky is seen from low down
                    near_ground = min(1.0, 0.62 + 0.2 * pz)
                for c in range(3):
                    a[c] *= sun[c] * lit + near_ground * (sky[c] * up + bounce[c] * (1.0 - up))
                    a[c] *= 1.0 + grain
                if kind == GLASS or kind == PAINT:
                    _reflect(rx / length, ry / length, rz / length, nx, ny, nz, kind, light, to_sun, clouds,
                             lit > 0.02, mirror, a)  # fmt: skip
            far = distance / haze_m
            veil = 1.0 - 1.0 / (1.0 + far + 0.48 * far * far + 0.235 * far * far * far)  # near 1 - exp(-far)
            veil *= veil
            for c in range(3):
                a[c] += (haze[c] - a[c]) * veil
            _put(picture, v, u, a, table, table_scale)


@njit(cache=True, nogil=True, inline="always")
def _put(picture, v, u, color, table, scale):
    for c in range(3):
        level = int(color[c] * scale)
        picture[v, u, 2 - c] = table[min(max(level, 0), table.shape[0] - 1)]


@njit(cache=True, nogil=True, error_model="numpy")
def _sky(x, y, z, light, to_sun, clouds, out):
    """Light from direction (x, y, z): horizon to zenith, clouds on a plane overhead, a glow around the sun."""
    zenith, horizon, cloud = light[3], light[4], light[6]
    up = max(z, 0.0)
    mix = 1.0 - (1.0 - up) * (1.0 - up) * (1.0 - up)
    size = clouds.shape[0]
    spread = 90.0 / (up + 0.18)
    fu, fv = x * spread, y * spread
    iu, iv = int(np.floor(fu)), int(np.floor(fv))
    wu, wv = fu - iu, fv - iv
    i0, i1, j0, j1 = iu & (size - 1), (iu + 1) & (size - 1), iv & (size - 1), (iv + 1) & (size - 1)
    cover = (clouds[j0, i0] * (1 - wu) + clouds[j0, i1] * wu) * (1 - wv) + (
        clouds[j1, i0] * (1 - wu) + clouds[j1, i1] * wu
    ) * wv
    cover *= min(1.0, up * 5.0) * 0.85
    toward = max(x * to_sun[0] + y * to_sun[1] + z * to_sun[2], 0.0)
    toward2 = toward * toward
    toward8 = toward2 * toward2 * toward2 * toward2
    glow = 0.18 * toward8 + 0.8 * toward8**24
    for c in range(3):
        base = horizon[c] + (zenith[c] - horizon[c]) * mix
        out[c] = base + (cloud[c] - base) * cover + glow * light[0, c]


@njit(cache=True, nogil=True, error_model="numpy")
def _reflect(x, y, z, nx, ny, nz, kind, light, to_sun, clouds, sunlit, mirror, color):
    """Mix the sky as mirrored by glass or paint into `color`; below the horizon a street is mirrored."""
    facing = -(x * nx + y * ny + z * nz)
    mx, my, mz = x + 2 * facing * nx, y + 2 * facing * ny, z + 2 * facing * nz
    grazing = 1.0 - min(max(facing, 0.0), 1.0)
    fresnel = grazing * grazing * grazing * grazing * grazing
    if mz > 0:
        if kind == GLASS:
            _sky(mx, my, mz, light, to_sun, clouds, mirror)
        else:
            for c in range(3):
                mirror[c] = light[4, c] + (light[3, c] - light[4, c]) * mz
        fade = min(1.0, mz * 4.0)
        for c in range(3):
            mirror[c] = mirror[c] * fade + 0.22 * light[4, c] * (1 - fade)
    else:
        for c in range(3):
            mirror[c] = 0.22 * light[4, c]
    share = 0.16 + 0.7 * fresnel if kind == GLASS else 0.035 + 0.5 * fresnel
    for c in range(3):
        color[c] += (mirror[c] - color[c]) * share
    if sunlit:
        toward = max(mx * to_sun[0] + my * to_sun[1] + mz * to_sun[2], 0.0)
        shine = toward**40 * (0.5 if kind == GLASS else 0.3)
        for c in range(3):
            color[c] += shine * light[0, c]


@njit(cache=True, nogil=True, error_model="numpy")
def _shadow(heights, x, y, z, origin_x, origin_y, texel, softness):
    """Share of the light, 0 to 1, that the shadow map holds back from a point at height z."""
    size = heights.shape[0]
    bias = z + 0.03 + texel * 0.5
    fu, fv = (x - origin_x) / texel - 0.5, (y - origin_y) / texel - 0.5
    if fu < 3 or fv < 3 or fu > size - 5 or fv > size - 5:
        return 0.0
    if softness > 0.5:  # no sun: a wide, weak occlusion under and beside things
        step = softness / texel * 0.35
        blocked = 0.0
        for j in range(-2, 3):
            for i in range(-2, 3):
                row = min(max(int(fv + j * step), 0), size - 1)
                column = min(max(int(fu + i * step), 0), size - 1)
                blocked += 1.0 if heights[row, column] > bias else 0.0
        return blocked / 25.0
    iu, iv = int(fu), int(fv)
    wu, wv = fu - iu, fv - iv
    b00 = 1.0 if heights[iv, iu] > bias else 0.0
    b01 = 1.0 if heights[iv, iu + 1] > bias else 0.0
    b10 = 1.0 if heights[iv + 1, iu] > bias else 0.0
    b11 = 1.0 if heights[iv + 1, iu + 1] > bias else 0.0
    return (b00 * (1 - wu) + b01 * wu) * (1 - wv) + (b10 * (1 - wu) + b11 * wu) * wv
