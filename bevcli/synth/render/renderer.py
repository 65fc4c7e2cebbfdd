"""Images of a moment: rasterise and shade every camera of a rig, and count what each object shows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, inverse
from bevcli.synth.render.ground_texture import GroundTexture
from bevcli.synth.render.lens import LensMaps, distortion_maps
from bevcli.synth.render.rasteriser import VisibilityBuffer, rasterise
from bevcli.synth.render.shading import ShadowMap, shade
from bevcli.synth.render.triangles import Soup
from bevcli.synth.world.weather import Weather


@dataclass(frozen=True)
class Moment:
    """Everything that cameras see at one time. object_count: objects are 0 to object_count - 1 in the soup."""

    soup: Soup
    object_count: int
    ground: GroundTexture
    shadows: ShadowMap
    weather: Weather


@dataclass(frozen=True)
class Exposure:
    """One camera's image. pixels_bgr: (H, W, 3) uint8. objects: (H, W) int32 object that each pixel sees, or -1.

    visible, unoccluded: (O,) pixels that each object shows, and would show if nothing stood before it.
    """

    pixels_bgr: NDArray[np.uint8]
    objects: NDArray[np.int32]
    visible: NDArray[np.int64]
    unoccluded: NDArray[np.int64]


def expose(moment: Moment, camera: Camera, world_from_ego: Array, supersampling: int = 1) -> Exposure:
    """The image that a camera takes. world_from_ego: (4, 4) at the camera's time.

    supersampling: samples a pixel along each side, averaged for the image; pixels are counted in whole pixels.
    A lens with distortion is served by resampling a wider pinhole image, objects by its nearest pixel.
    """
    if camera.distortion is not None:
        lens = distortion_maps(camera)
        return _through(lens, expose(moment, lens.pinhole, world_from_ego, supersampling), moment.object_count)
    fine = supersampled(camera, supersampling)
    world_from_camera = world_from_ego @ camera.ego_from_camera
    buffer = rasterise(
        moment.soup.surfaces.corners,
        moment.soup.surfaces.normals,
        moment.soup.runs,
        moment.soup.objects,
        moment.soup.spheres,
        fine,
        inverse(world_from_camera),
        moment.object_count,
    )
    image = shade(buffer, moment.soup.surfaces, moment.ground, moment.shadows, moment.weather, fine, world_from_camera)
    objects = seen_objects(buffer, moment.soup)
    area = supersampling**2
    visible = np.bincount(objects[objects >= 0], minlength=moment.object_count)
    if supersampling > 1:
        image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA).astype(np.uint8)
        objects = np.ascontiguousarray(objects[::supersampling, ::supersampling])
    return Exposure(image, objects, visible // area, -(-buffer.unoccluded // area))


def _through(lens: LensMaps, pinhole: Exposure, object_count: int) -> Exposure:
    """What the lens makes of its pinhole image; unoccluded pixels are scaled as the visible ones."""
    image = cv2.remap(pinhole.pixels_bgr, lens.x, lens.y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    rows, columns = np.round(lens.y).astype(int), np.round(lens.x).astype(int)
    objects = pinhole.objects[rows, columns]
    visible = np.bincount(objects[objects >= 0], minlength=object_count)
    share = np.minimum(pinhole.visible / np.maximum(pinhole.unoccluded, 1), 1.0)
    unoccluded = np.where(visible > 0, np.ceil(visible / np.maximum(share, 1e-6)), pinhole.unoccluded)
    return Exposure(image.astype(np.uint8), objects, visible, unoccluded.astype(np.int64))


def supersampled(camera: Camera, factor: int) -> Camera:
    """The camera with `factor` times as many pixels a side, each pixel cut into equal parts about its centre."""
    if factor == 1:
        return camera
    scaled = camera.scaled(factor)
    shift = np.array([[1.0, 0, (factor - 1) / 2], [0, 1.0, (factor - 1) / 2], [0, 0, 1.0]])
    return replace(scaled, intrinsics=shift @ scaled.intrinsics)


def seen_objects(buffer: VisibilityBuffer, soup: Soup) -> NDArray[np.int32]:
    """(H, W) int32 object that each pixel sees, -1 for none."""
    owners = np.repeat(soup.objects, soup.runs[:, 1] - soup.runs[:, 0])
    return np.where(buffer.triangles >= 0, owners[buffer.triangles], -1).astype(np.int32)
