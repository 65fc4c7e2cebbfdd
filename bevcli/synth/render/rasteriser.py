"""The z-buffer rasteriser: world triangles -> which triangle each pixel sees, and how far away it is.

Deferred: nothing is shaded here, so every pixel is shaded once. Because each object's triangles come in one run,
the pixels that an object would cover if it stood alone are counted in the same pass.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, inverse
from bevcli.synth.render.raster_kernels import rasterise_heights, rasterise_runs


@dataclass(frozen=True)
class VisibilityBuffer:
    """What each pixel of one image sees.

    triangles: (H, W) int32 index of the nearest triangle, -1 for none. inverse_depth: (H, W) float32, 1/m.
    unoccluded: (O,) int64 pixels that each object would cover alone in the image; for one that is wholly hidden by
    what was drawn before it, it may be 0.
    """

    triangles: NDArray[np.int32]
    inverse_depth: NDArray[np.float32]
    unoccluded: NDArray[np.int64]


def rasterise(
    corners: NDArray[np.float32],
    normals: NDArray[np.float32],
    runs: NDArray[np.int64],
    run_objects: NDArray[np.int32],
    run_spheres: NDArray[np.float32],
    camera: Camera,
    camera_from_world: Array,
    object_count: int,
) -> VisibilityBuffer:
    """Rasterise triangles into one image. The camera's distortion is not applied.

    corners: (T, 3, 3) world metres, counter-clockwise seen from outside; back faces are not drawn. normals: (T, 3).
    runs: (R, 2) first and last-plus-one triangle of each run. run_objects: (R,) object that the run belongs to,
    -1 for none; the runs of one object follow each other. run_spheres: (R, 4) bounding sphere x, y, z, radius.
    camera_from_world: (4, 4).
    """
    shape = (camera.height, camera.width)
    triangles = np.full(shape, -1, np.int32)
    inverse_depth = np.zeros(shape, np.float32)
    stamps = np.full(shape, -1, np.int32)
    unoccluded = np.zeros(object_count, np.int64)
    k = camera.intrinsics
    pinhole = np.array([k[0, 0], k[0, 1], k[0, 2], k[1, 1], k[1, 2]])
    rasterise_runs(
        corners, normals, runs, run_objects, run_spheres, np.ascontiguousarray(camera_from_world[:3]), pinhole,
        inverse(camera_from_world)[:3, 3].copy(), triangles, inverse_depth, stamps, unoccluded,
    )  # fmt: skip
    return VisibilityBuffer(triangles, inverse_depth, unoccluded)


def heights_from_sun(
    corners: NDArray[np.float32], shear: tuple[float, float], origin: tuple[float, float], texel_m: float, size: int
) -> NDArray[np.float32]:
    """How high the light is blocked over each ground point: a shadow map, sheared along the light.

    corners: (T, 3, 3) world metres. shear: metres that a shadow moves in x and y for each metre of height.
    A point at height h over (x, y) lies in shadow where the map at (x, y) + h * shear exceeds h.
    Returns (size, size) float32 metres, rows along y from origin; -1 where nothing blocks.
    """
    heights = np.full((size, size), -1.0, np.float32)
    add_heights_from_sun(corners, shear, origin, texel_m, heights)
    return heights


def add_heights_from_sun(
    corners: NDArray[np.float32],
    shear: tuple[float, float],
    origin: tuple[float, float],
    texel_m: float,
    heights: NDArray[np.float32],
) -> None:
    """Draw more triangles into a map of `heights_from_sun`, in place."""
    rasterise_heights(corners, shear[0], shear[1], origin[0], origin[1], 1.0 / texel_m, heights)
