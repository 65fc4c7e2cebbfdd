"""The image of one camera: rasterise and shade the world, and count the pixels of each object.

Each pixel is shaded once, in linear RGB. All surfaces are diffuse; glass and paint also reflect the sky. The ground has
no triangles: a pixel that sees none and looks down sees the plane z = 0. The image of a camera with distortion is
resampled from a wider pinhole image, that of a wide fisheye from up to five.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, inverse
from bevcli.workshop.synth.assets.mesh import TriangleSoup
from bevcli.workshop.synth.render.ground import GroundTexture
from bevcli.workshop.synth.render.lens import LensPart
from bevcli.workshop.synth.render.rasteriser import ShadowMap, VisibilityBuffer, rasterise
from bevcli.workshop.synth.render.shading_kernels import LIGHT_LIMIT, shade_pixels
from bevcli.workshop.synth.world.weather import Weather

NO_PATTERN = (0.0, 1.0, 0.0)


@dataclass(frozen=True)
class WorldSnapshot:
    """The world at one time, as the renderer needs it.

    Attributes:
        soup: all triangles around the vehicle.
        object_count: O; the annotated objects in the soup are 0 to O - 1.
        ground: texture of the ground.
        shadows: shadow map.
        weather: light, sky and haze.
        pattern: strength, waves per metre and hardness of a pattern on all surfaces but the ground.
    """

    soup: TriangleSoup
    object_count: int
    ground: GroundTexture
    shadows: ShadowMap
    weather: Weather
    pattern: tuple[float, float, float] = NO_PATTERN


@dataclass(frozen=True)
class RenderedView:
    """The image of one camera, with its ground truth.

    Attributes:
        pixels_bgr: (H, W, 3) uint8.
        objects: (H, W) index of the object that each pixel sees; -1 for none.
        visible: (O,) number of pixels that show each object.
        unoccluded: (O,) number of pixels that would show each object without occlusion.
    """

    pixels_bgr: NDArray[np.uint8]
    objects: NDArray[np.int32]
    visible: NDArray[np.int64]
    unoccluded: NDArray[np.int64]


def render_view(
    snapshot: WorldSnapshot,
    camera: Camera,
    world_from_ego: Array,
    supersampling: int = 1,
    needed: NDArray[np.uint8] | None = None,
) -> RenderedView:
    """Render the image of a camera.

    world_from_ego: (4, 4) at the time of the image. supersampling: samples per pixel along each axis; the image is
    their mean, `visible` and `unoccluded` count whole pixels. The camera's distortion is ignored.
    needed: (H, W) 0 for pixels that may stay black. Default: all are coloured.
    """
    soup = snapshot.soup
    fine = _supersampled(camera, supersampling)
    world_from_camera = world_from_ego @ camera.ego_from_camera
    buffer = rasterise(soup, fine, inverse(world_from_camera), snapshot.object_count)
    wanted = np.ones((camera.height, camera.width), np.uint8) if needed is None else needed
    wanted = wanted.repeat(supersampling, axis=0).repeat(supersampling, axis=1)
    image = shade(snapshot, buffer, fine, world_from_camera, wanted)
    objects = _seen_objects(buffer, soup)
    area = supersampling**2
    visible = np.bincount(objects[objects >= 0], minlength=snapshot.object_count)
    if supersampling > 1:
        image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA).astype(np.uint8)
        objects = np.ascontiguousarray(objects[::supersampling, ::supersampling])
    return RenderedView(image, objects, visible // area, -(-buffer.unoccluded // area))


def render_through_lens(
    snapshot: WorldSnapshot, parts: Sequence[LensPart], world_from_ego: Array, supersampling: int = 1
) -> RenderedView:
    """Render the image of a camera with distortion, as `render_view` does.

    parts: its `lens_parts`. Their images are resampled: linearly for colours, by the nearest pixel for objects. The
    ratio of visible to unoccluded pixels of each object is that of the parts. What no part gives is black.
    """
    views = [render_view(snapshot, part.pinhole, world_from_ego, supersampling, part.needed) for part in parts]
    shape = parts[0].columns.shape
    image, seen = np.zeros((*shape, 3), np.uint8), np.full(shape, -1, np.float32)  # OpenCV resamples no int32
    for view, part in zip(views, parts, strict=True):
        at = (part.columns, part.rows)
        cv2.remap(view.pixels_bgr, *at, cv2.INTER_LINEAR, image, cv2.BORDER_TRANSPARENT)
        cv2.remap(view.objects.astype(np.float32), *at, cv2.INTER_NEAREST, seen, cv2.BORDER_TRANSPARENT)
    objects = seen.astype(np.int32)
    seen_flat = np.sum([view.visible for view in views], axis=0)
    unoccluded_flat = np.sum([view.unoccluded for view in views], axis=0)
    visible = np.bincount(objects[objects >= 0], minlength=len(seen_flat))
    share = np.minimum(seen_flat / np.maximum(unoccluded_flat, 1), 1.0)
    unoccluded = np.where(visible > 0, np.ceil(visible / np.maximum(share, 1e-6)), unoccluded_flat)
    return RenderedView(image, objects, visible, unoccluded.astype(np.int64))


def _supersampled(camera: Camera, factor: int) -> Camera:
    """The camera with each pixel divided into factor x factor equal parts."""
    scaled = camera.scaled(factor)
    shift = np.array([[1.0, 0, (factor - 1) / 2], [0, 1.0, (factor - 1) / 2], [0, 0, 1.0]])
    return replace(scaled, intrinsics=shift @ scaled.intrinsics)


def _seen_objects(buffer: VisibilityBuffer, soup: TriangleSoup) -> NDArray[np.int32]:
    """(H, W) index of the object that each pixel sees; -1 for none."""
    owners = np.repeat(soup.mesh_objects, soup.mesh_ranges[:, 1] - soup.mesh_ranges[:, 0])
    return np.append(owners, -1).astype(np.int32)[buffer.triangles]  # triangle -1 is the last entry


TABLE_SIZE = 4096


def shade(
    snapshot: WorldSnapshot,
    buffer: VisibilityBuffer,
    camera: Camera,
    world_from_camera: Array,
    needed: NDArray[np.uint8],
) -> NDArray[np.uint8]:
    """Colour a visibility buffer. Returns (H, W, 3) uint8 BGR.

    camera: the buffer's camera; its distortion is ignored. world_from_camera: (4, 4). needed: as in `render_view`.
    """
    soup, ground, shadows, w = snapshot.soup, snapshot.ground, snapshot.shadows, snapshot.weather
    ray_from_image = world_from_camera[:3, :3] @ np.linalg.inv(camera.intrinsics)
    image = np.zeros((*buffer.triangles.shape, 3), np.uint8)
    shade_pixels(
        (buffer.triangles, buffer.inverse_depth),
        (soup.normals, soup.albedo, soup.material, soup.facade, soup.facades, snapshot.pattern),
        (ground.texels, ground.offsets, ground.rough, *ground.origin, ground.texel_m, ground.size),
        (shadows.heights, *shadows.origin, shadows.texel_m, *shadows.shear, w.kind.shadow_softness_m),
        (w.light, w.to_sun, w.clouds, w.kind.haze_m, w.kind.lamps),
        (ray_from_image, np.ascontiguousarray(world_from_camera[:3, 3]), 1.0 / camera.intrinsics[0, 0]),
        _display_table(),
        needed,
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
