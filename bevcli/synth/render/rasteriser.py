"""The z-buffer rasteriser: which triangle each pixel sees, and at which depth.

It computes no colours: each pixel is shaded once, later (deferred shading). The triangles of an object follow each
other, so the pixels that it would cover without occlusion are counted in the same pass.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, inverse
from bevcli.synth.assets.triangles import TriangleSoup
from bevcli.synth.render.raster_kernels import rasterise_meshes


@dataclass(frozen=True)
class VisibilityBuffer:
    """What each pixel of one image sees.

    Attributes:
        triangles: (H, W) index of the nearest triangle; -1 for none.
        inverse_depth: (H, W) 1 / depth, 1/metres; 0 for none.
        unoccluded: (O,) number of pixels that each object would cover without occlusion. It can be too small (down to
            0) for an object that is hidden completely.
    """

    triangles: NDArray[np.int32]
    inverse_depth: NDArray[np.float32]
    unoccluded: NDArray[np.int64]


def rasterise(soup: TriangleSoup, camera: Camera, camera_from_world: Array, object_count: int) -> VisibilityBuffer:
    """Rasterise triangles into one image. Back faces are not drawn; the camera's distortion is not applied.

    camera_from_world: (4, 4). object_count: O; the objects in the soup are 0 to O - 1.
    """
    shape = (camera.height, camera.width)
    triangles = np.full(shape, -1, np.int32)
    inverse_depth = np.zeros(shape, np.float32)
    last_objects = np.full(shape, -1, np.int32)
    unoccluded = np.zeros(object_count, np.int64)
    k = camera.intrinsics
    pinhole = np.array([k[0, 0], k[0, 1], k[0, 2], k[1, 1], k[1, 2]])
    rasterise_meshes(
        (soup.triangles.corners, soup.triangles.normals),
        (soup.mesh_ranges, soup.mesh_objects, soup.mesh_spheres),
        np.ascontiguousarray(camera_from_world[:3]), pinhole, inverse(camera_from_world)[:3, 3].copy(),
        triangles, inverse_depth, last_objects, unoccluded,
    )  # fmt: skip
    return VisibilityBuffer(triangles, inverse_depth, unoccluded)
