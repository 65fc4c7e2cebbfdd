"""Some of the points that a step was measured from, in the images of its second frame: what a recording shows."""

from collections.abc import Sequence as Items
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array
from bevcli.workshop.correspondence.residuals import Indices

MOST = 60  # of each camera and kind


@dataclass(frozen=True)
class SeenPoints:
    """N points of a step.

    Attributes:
        camera: (N,) index in the rig.
        at: (N, 2) place in the image of the second frame, as shares of its width and height.
        residuals_px: (N,) distance from where the measured motion puts it, pixels of the reduced image.
        is_road: (N,) True for a point of the road, False for a matched one.
    """

    camera: NDArray[np.int16]
    at: NDArray[np.float32]
    residuals_px: NDArray[np.float32]
    is_road: NDArray[np.bool_]


def seen_points(cameras: Items[Camera], *kinds: tuple[Indices, Array, Array]) -> SeenPoints:
    """An even choice of points.

    cameras: of the second frame. kinds: matched points and points of the road, each with the camera (n,), the ray
    (n, 3) in its frame, and the residual (n, D).
    """
    columns: list[tuple[Indices, Array, Array, NDArray[np.bool_]]] = []
    for is_road, (of, rays, residuals) in enumerate(kinds):
        for index, camera in enumerate(cameras):
            mine = np.flatnonzero(of == index)
            chosen = mine[:: max(1, -(-len(mine) // MOST))]
            pixels, _ = camera.project(rays[chosen])
            sizes = np.linalg.norm(residuals[chosen], axis=-1)
            kind = np.full(len(chosen), bool(is_road))
            columns.append((np.full(len(chosen), index), pixels / (camera.width, camera.height), sizes, kind))
    camera_of, at, sizes, kind = (np.concatenate(column) for column in zip(*columns, strict=True))
    return SeenPoints(camera_of.astype(np.int16), at.astype(np.float32), sizes.astype(np.float32), kind)
