"""The image of one camera: rasterise and shade the world, and count the pixels of each object."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, inverse
from bevcli.synth.assets.triangles import TriangleSoup
from bevcli.synth.render.ground_texture import GroundTexture
from bevcli.synth.render.lens import LensMaps, distortion_maps
from bevcli.synth.render.rasteriser import VisibilityBuffer, rasterise
from bevcli.synth.render.shading import shade
from bevcli.synth.render.shadow_map import ShadowMap
from bevcli.synth.world.weather import Weather


@dataclass(frozen=True)
class WorldSnapshot:
    """The world at one time, as the renderer needs it.

    Attributes:
        soup: all triangles around the vehicle.
        object_count: O; the annotated objects in the soup are 0 to O - 1.
        ground: texture of the ground.
        shadows: shadow map.
        weather: light, sky and haze.
    """

    soup: TriangleSoup
    object_count: int
    ground: GroundTexture
    shadows: ShadowMap
    weather: Weather


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


def render_view(snapshot: WorldSnapshot, camera: Camera, world_from_ego: Array, supersampling: int = 1) -> RenderedView:
    """Render the image of a camera.

    world_from_ego: (4, 4) at the time of the image. supersampling: samples per pixel along each axis; the image is
    their mean, `visible` and `unoccluded` count whole pixels. For a camera with distortion a wider pinhole image is
    rendered and resampled: linearly for colours, by the nearest pixel for objects.
    Raises InputError where the field of view is too wide.
    """
    if camera.distortion is not None:
        lens = distortion_maps(camera)
        return _distorted(lens, render_view(snapshot, lens.pinhole, world_from_ego, supersampling))
    soup = snapshot.soup
    fine = _supersampled(camera, supersampling)
    world_from_camera = world_from_ego @ camera.ego_from_camera
    buffer = rasterise(soup, fine, inverse(world_from_camera), snapshot.object_count)
    image = shade(buffer, soup.triangles, snapshot.ground, snapshot.shadows, snapshot.weather, fine, world_from_camera)
    objects = _seen_objects(buffer, soup)
    area = supersampling**2
    visible = np.bincount(objects[objects >= 0], minlength=snapshot.object_count)
    if supersampling > 1:
        image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA).astype(np.uint8)
        objects = np.ascontiguousarray(objects[::supersampling, ::supersampling])
    return RenderedView(image, objects, visible // area, -(-buffer.unoccluded // area))


def _distorted(lens: LensMaps, pinhole: RenderedView) -> RenderedView:
    """Resample a pinhole image. The ratio of visible to unoccluded pixels of each object stays as it is."""
    image = cv2.remap(pinhole.pixels_bgr, lens.x, lens.y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    rows, columns = np.round(lens.y).astype(int), np.round(lens.x).astype(int)
    objects = pinhole.objects[rows, columns]
    visible = np.bincount(objects[objects >= 0], minlength=len(pinhole.visible))
    share = np.minimum(pinhole.visible / np.maximum(pinhole.unoccluded, 1), 1.0)
    unoccluded = np.where(visible > 0, np.ceil(visible / np.maximum(share, 1e-6)), pinhole.unoccluded)
    return RenderedView(image.astype(np.uint8), objects, visible, unoccluded.astype(np.int64))


def _supersampled(camera: Camera, factor: int) -> Camera:
    """The camera with each pixel divided into factor x factor equal parts."""
    if factor == 1:
        return camera
    scaled = camera.scaled(factor)
    shift = np.array([[1.0, 0, (factor - 1) / 2], [0, 1.0, (factor - 1) / 2], [0, 0, 1.0]])
    return replace(scaled, intrinsics=shift @ scaled.intrinsics)


def _seen_objects(buffer: VisibilityBuffer, soup: TriangleSoup) -> NDArray[np.int32]:
    """(H, W) index of the object that each pixel sees; -1 for none."""
    owners = np.repeat(soup.mesh_objects, soup.mesh_ranges[:, 1] - soup.mesh_ranges[:, 0])
    return np.where(buffer.triangles >= 0, owners[buffer.triangles], -1).astype(np.int32)
